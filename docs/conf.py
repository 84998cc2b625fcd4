"""The site of the documentation: Sphinx, with MyST for the Markdown pages and notebooks, and furo for the looks.

Pages of the command line and of the modules are written anew by each build (``_site/``) into docs/cli and docs/api.
Nothing in the built site asks the network for anything: formulas are MathML, their font comes along.
"""

import sys
from importlib.metadata import version as installed_version
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

project = "cuspid"
release = installed_version("cuspid")
author = "the cuspid authors"
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx_copybutton",
    "_site.command_pages",
    "_site.module_pages",
    "_site.docstrings",
    "_site.formulas",
]
exclude_patterns = ["_site"]

nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_merge_streams = True

html_theme = "furo"
html_title = "cuspid"
html_static_path = ["_site/static"]
html_css_files = ["cuspid.css"]
html_js_files = ["cuspid.js"]
html_show_sphinx = False
html_show_copyright = False
html_show_sourcelink = False
html_copy_source = False
html_math_renderer = "mathml"
html_theme_options = {"navigation_with_keys": True}
smartquotes = False  # "--option" shall stay as it is typed.
pygments_style = "a11y-high-contrast-light"  # furo brings both
pygments_dark_style = "a11y-high-contrast-dark"

myst_enable_extensions = ["attrs_block", "deflist", "dollarmath"]
myst_heading_anchors = 4
myst_fence_as_directive = ["math"]

autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 140
add_module_names = False
toc_object_entries = False

copybutton_exclude = ".linenos, .gp, .go, .c1"
