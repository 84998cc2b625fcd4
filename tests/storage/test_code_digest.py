"""The digest of code goes by what it does: a comment or a new place changes nothing, a statement below does."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

import cuspid
from cuspid.storage.code_digest import Code, meaning

SOURCE = Path(cuspid.__file__).parent
ENTRY = "cuspid.stage"
SMALL: Mapping[str, str] = {
    "cuspid": "from .tools.deep import grown as grown\n",
    ENTRY: "import os\nfrom cuspid import near\nfrom cuspid.tools import deep\nfrom cuspid.near import once\n"
    "def f(x):\n    from cuspid.far import g\n    return g(once(x)) + deep.grown(x)\n",
    "cuspid.near": "def once(x):\n    return x\n",
    "cuspid.far": "from cuspid.tools.deep import grown\ndef g(x):\n    return grown(x)\n",
    "cuspid.tools": "",
    "cuspid.tools.deep": "def grown(x):\n    return x + 1\n",
    "cuspid.aside": "def once(x):\n    return x\n",
}


def digest(texts: Mapping[str, str], module: str = ENTRY, without: tuple[str, ...] = ()) -> str:
    return Code(lambda name: texts[name].encode() if name in texts else None, without).digest(module)


def changed(**texts: str) -> dict[str, str]:
    return {**SMALL, **{name.replace("_", "."): text for name, text in texts.items()}}


READ_ONLY = {
    "a comment": {"cuspid_far": SMALL["cuspid.far"] + "# said\n"},
    "a docstring": {"cuspid_far": '"""What it is."""\n' + SMALL["cuspid.far"].replace(":\n", ':\n    """Said."""\n')},
    "the layout": {"cuspid_near": "def once(\n    x,\n):\n\n    return (x)\n"},
    "the order of imports": {
        "cuspid_stage": SMALL[ENTRY]
        .replace("from cuspid import near\nfrom cuspid.tools import deep\n", "")
        .replace("import os\n", "import os\nfrom cuspid.tools import deep\nfrom cuspid import near\n")
    },
    "a module that is not used": {"cuspid_aside": "def once(x):\n    return 2\n"},
    "what else the package offers": {"cuspid": SMALL["cuspid"] + "from .aside import once as once\n"},
}


@pytest.mark.parametrize("texts", READ_ONLY.values(), ids=READ_ONLY.keys())
def test_what_changes_nothing_keeps_the_digest(texts: dict[str, str]) -> None:
    assert changed(**texts) != SMALL
    assert digest(changed(**texts)) == digest(SMALL)


THRICE = {"cuspid.aside": "def once(x):\n    return 3 * x\n"}
DONE = {
    "a statement": {"cuspid_near": "def once(x):\n    return -x\n"},
    "a statement far below": {"cuspid_tools_deep": "def grown(x):\n    return x + 2\n"},
    "what runs when it is loaded": {"cuspid_tools_deep": SMALL["cuspid.tools.deep"] + "print()\n"},
    "another import": {"cuspid_stage": SMALL[ENTRY].replace("import os", "import sys")},
    "the name under which it is imported": {"cuspid_stage": SMALL[ENTRY].replace("import once", "import once as two")},
}


@pytest.mark.parametrize("texts", DONE.values(), ids=DONE.keys())
def test_what_changes_something_changes_the_digest(texts: dict[str, str]) -> None:
    assert digest(changed(**texts)) != digest(SMALL)


def test_a_function_from_elsewhere_is_another_one_although_it_has_the_same_name() -> None:
    """Both modules are there before and after, and only the import tells which is called."""
    other = {**SMALL, **THRICE, "cuspid.far": "from cuspid.aside import once\n"}
    first = {**other, ENTRY: "from cuspid.far import once as a\nfrom cuspid.near import once as b\n"}
    second = {**other, ENTRY: "from cuspid.near import once as a\nfrom cuspid.far import once as b\n"}
    assert digest(first) != digest(second)


def test_imports_in_functions_stay_with_their_functions() -> None:
    text = "".join(f"def {name}():\n    from cuspid.{{}} import once\n    return once\n" for name in "fg")
    both = [digest({**SMALL, **THRICE, ENTRY: text.format(*names)}) for names in (("near", "aside"), ("aside", "near"))]
    assert both[0] != both[1]


def test_a_module_may_move() -> None:
    moved = {name.replace("tools.deep", "tools.further.down"): text for name, text in SMALL.items()}
    moved = {name: text.replace("tools.deep", "tools.further.down") for name, text in moved.items()}
    moved[ENTRY] = moved[ENTRY].replace(
        "from cuspid.tools import deep", "from cuspid.tools.further import down as deep"
    )
    moved["cuspid.tools.further"] = ""
    assert digest(moved) == digest(SMALL)


def test_what_the_package_offers_is_what_it_is_there() -> None:
    by_name = {**SMALL, ENTRY: "import cuspid\nprint(cuspid.grown(1), cuspid.__version__)\n"}
    below = {**by_name, "cuspid.tools.deep": "def grown(x):\n    return x + 2\n"}
    assert digest(by_name) != digest(below)
    taken = {**SMALL, ENTRY: "from cuspid import grown\n"}
    assert digest(taken) != digest({**taken, "cuspid.tools.deep": below["cuspid.tools.deep"]})


def test_modules_that_are_left_out_count_by_their_names_alone() -> None:
    other = changed(cuspid_tools_deep="def grown(x):\n    return x + 2\n")
    assert digest(other, without=("cuspid.tools",)) == digest(SMALL, without=("cuspid.tools",))
    assert digest(other, without=("cuspid.to",)) != digest(SMALL, without=("cuspid.to",))


def test_modules_are_those_that_are_reached() -> None:
    code = Code(lambda name: SMALL[name].encode() if name in SMALL else None)
    assert code.modules([ENTRY]) == {ENTRY, "cuspid.near", "cuspid.far", "cuspid.tools.deep"}
    with pytest.raises(LookupError, match=r"no module cuspid\.lost"):
        code.digest("cuspid.lost")
    with pytest.raises(LookupError, match="relative to its own"):
        digest({**SMALL, ENTRY: "from . import near\n"})


def read(module: str) -> bytes | None:
    path = SOURCE.joinpath(*module.split(".")[1:])
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return file.read_bytes() if module.startswith("cuspid.") and file.is_file() else None


FEATURES = "cuspid.motion.frontend.features"


def test_features_that_were_found_outlive_comments_and_a_move() -> None:
    """Of the real code: a remark at the end of each module, and the cameras' models in a package of another name."""
    texts = {name: text for name in Code(read).modules([FEATURES]) if (text := read(name)) is not None}
    assert len(texts) > 20
    old, new = "cuspid.geometry", "cuspid.rigid_motions"
    moved = {
        name.replace(old, new): text.replace(old.encode(), new.encode()) + b"\n# a remark\n"
        for name, text in texts.items()
    }
    assert moved.keys() != texts.keys()
    assert Code(moved.get).digest(FEATURES) == Code(texts.get).digest(FEATURES)
    changed = {**moved, f"{new}.rigid": moved[f"{new}.rigid"] + b"\nNEW = 1\n"}
    assert Code(changed.get).digest(FEATURES) != Code(texts.get).digest(FEATURES)


def test_the_meaning_of_a_file_is_its_statements() -> None:
    assert meaning(b"x = 1  # one\n") == meaning(b'"""Said."""\nx = 1\n') != meaning(b"x = 2\n")
