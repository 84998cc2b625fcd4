"""Formulas as MathML, which browsers draw themselves, by the converter of docutils. What it cannot read is an error.

The font is STIX Two Math (SIL Open Font License), cut down to what formulas need.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from fontTools import subset
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.writers.html5 import HTML5Translator

LETTERS = "U+20-7E,U+A0-FF,U+370-3FF,U+2000-22FF,U+2308-230B,U+27E8-27E9,U+2A00-2A0F,U+1D400-1D7FF"
logger = logging.getLogger(__name__)


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_html_math_renderer("mathml", inline_renderers=(_inline, None), block_renderers=(_block, None))
    app.connect("build-finished", _write_font)
    return {"parallel_read_safe": True}


def _inline(translator: HTML5Translator, node: nodes.math) -> None:
    translator.body.append(_mathml(node, as_block=False))
    raise nodes.SkipNode


def _block(translator: HTML5Translator, node: nodes.math_block) -> None:
    number = f'<span class="eqno">({node["number"]})</span>' if node["number"] else ""
    translator.body.append(f'<div class="formula">{_mathml(node, as_block=True)}{number}</div>\n')
    raise nodes.SkipNode


def _mathml(node: nodes.Element, *, as_block: bool) -> str:
    try:
        return tex2mathml(node.astext(), as_block=as_block)
    except MathError as error:
        logger.warning("formula %r: %s", node.astext(), error, location=node)
        return ""


def _write_font(app: Sphinx, failure: Exception | None) -> None:
    """The font comes with ziamath, of which nothing else is used."""
    target = Path(app.outdir) / "_static" / "formulas.woff"
    if failure is None and app.builder.format == "html" and not target.exists():
        source = files("ziamath") / "fonts" / "STIXTwoMath-Regular.ttf"
        subset.main([str(source), f"--unicodes={LETTERS}", "--flavor=woff", f"--output-file={target}"])
