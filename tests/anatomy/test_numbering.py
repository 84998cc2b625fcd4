"""Labels of any numbering are those of the teeth that stand there, or are refused."""

import json
from pathlib import Path

import numpy as np
import pytest

from builders import any_pose
from cuspid import storage
from cuspid.anatomy.jaw_files import Labelling, load_jaw
from cuspid.anatomy.numbering import Numbering, number_teeth
from cuspid.cli import main
from cuspid.model.jaw import GUM, UNIVERSAL_FROM_FDI, Arch, Jaw
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from horseshoe import horseshoe

LOWER = horseshoe(150, 40)
ROW = [*range(37, 30, -1), *range(41, 48)]
"""From the patient's left, which is -X in a lower jaw."""


def upper() -> Jaw:
    """The same as an upper jaw: +X is the left there."""
    return Jaw(mesh=LOWER.mesh, face_labels=replaced(LOWER.face_labels, UPPER), arch="upper")


def replaced(labels: np.ndarray, table: dict[int, int]) -> np.ndarray:
    return np.array([table.get(int(each), GUM) for each in labels])


UPPER = {fdi: 10 * {3: 1, 4: 2}[fdi // 10] + fdi % 10 for fdi in ROW}
ALONG = dict(zip(ROW, range(1, 15), strict=True))
NUMBERINGS = {
    "1-14 from the left": ALONG,
    "1-14 from the right": {fdi: 15 - n for fdi, n in ALONG.items()},
    "1-16 from the left": {fdi: n + 1 for fdi, n in ALONG.items()},
    "1-16 from the right": {fdi: 16 - n for fdi, n in ALONG.items()},
    "halves, left first": {fdi: fdi % 10 + (7 if fdi > 40 else 0) for fdi in ROW},
    "halves of 8, right first": {fdi: fdi % 10 + (8 if fdi < 40 else 0) for fdi in ROW},
    "Palmer": {fdi: fdi % 10 for fdi in ROW},
}


@pytest.mark.parametrize("name", NUMBERINGS)
@pytest.mark.parametrize("arch", ["lower", "upper"])
def test_each_numbering_is_told_from_where_the_teeth_stand(name: str, arch: Arch) -> None:
    truth = LOWER if arch == "lower" else upper()
    labels = replaced(LOWER.face_labels, NUMBERINGS[name])
    universal = name == "1-16 from the left"
    """These are the Universal numbers of an upper jaw."""
    if universal and arch == "lower":
        with pytest.raises(InputError, match=r"Universal numbers of upper teeth.*or --labels along-arch$"):
            number_teeth("jaw.ply", labels, truth.mesh, arch=arch)
    along: Numbering = "along-arch" if universal and arch == "lower" else "auto"
    found = number_teeth("jaw.ply", labels, truth.mesh, arch=arch, numbering=along)
    assert np.mean(found.labels != truth.face_labels) < (0.006 if name == "Palmer" else 1e-9)
    assert found.notes == () if universal and arch == "upper" else "overrides" in found.notes[0]


def test_labels_along_a_small_arch_are_not_taken_for_those_of_the_other_jaw() -> None:
    mesh = Mesh(LOWER.mesh.vertices * [0.9, 0.9, 1] - [2, 0, 0], LOWER.mesh.faces)
    found = number_teeth("jaw.ply", replaced(LOWER.face_labels, ALONG), mesh, arch="lower")
    assert np.array_equal(found.labels, LOWER.face_labels)


@pytest.mark.parametrize("missing", [(), (36,), (41, 31), (37, 47), (34, 44)])
def test_fdi_and_universal_numbers_are_what_they_are(missing: tuple[int, ...]) -> None:
    labels = np.where(np.isin(LOWER.face_labels, missing), GUM, LOWER.face_labels)
    for given in (labels, replaced(labels, UNIVERSAL_FROM_FDI)):
        for arch in (None, "lower"):
            found = number_teeth("jaw.ply", given, LOWER.mesh, arch=arch)
            assert np.array_equal(found.labels, labels)
            assert found.notes == ()


@pytest.mark.parametrize(
    ("labels", "arch", "said"),
    [
        (NUMBERINGS["1-14 from the left"], None, r"no Universal numbers.*1-14 along the arch fits: give --arch"),
        (NUMBERINGS["Palmer"], None, r"Palmer.*--arch"),
        ({fdi: fdi for fdi in ROW}, "upper", r"FDI numbers of lower teeth.*says upper; give --arch lower$"),
        (
            {fdi: fdi + (10 if fdi < 40 else -10) for fdi in ROW},
            "lower",
            "no other numbering fits; is the mesh mirrored",
        ),
        ({fdi: 50 + n for fdi, n in ALONG.items()}, "lower", "not understood.*--label-map"),
    ],
)
def test_what_contradicts_the_teeth_is_refused(labels: dict[int, int], arch: Arch | None, said: str) -> None:
    with pytest.raises(InputError, match=said):
        number_teeth("jaw.ply", replaced(LOWER.face_labels, labels), LOWER.mesh, arch=arch)


def test_of_a_part_the_numbers_tell() -> None:
    """Where the midline is not known; but not against the arch that is given."""
    part = LOWER.mesh.face_centres[:, 0] > 8
    mesh, labels = LOWER.mesh.submesh(part), LOWER.face_labels[part]
    for given in (labels, replaced(labels, UNIVERSAL_FROM_FDI)):
        assert np.array_equal(number_teeth("jaw.ply", given, mesh, sure=False).labels, labels)
        with pytest.raises(InputError, match="lower teeth, but its name or --arch says upper"):
            number_teeth("jaw.ply", given, mesh, sure=False, arch="upper")


@pytest.mark.long
def test_a_map_says_what_labels_are(tmp_path: Path) -> None:
    table = {fdi: 100 + n for fdi, n in ALONG.items()}
    storage.write_mesh(
        tmp_path / "jaw.ply", LOWER.mesh.transformed(any_pose(1, 40)), replaced(LOWER.face_labels, table)
    )
    (tmp_path / "map.json").write_text(json.dumps({str(n): fdi for fdi, n in table.items()}))
    jaw, _ = load_jaw(tmp_path / "jaw.ply", labelling=Labelling(label_map=tmp_path / "map.json"))
    assert sorted(jaw.teeth) == sorted(ROW)
    for text, said in (("{}", "must hold"), ('{"x": 31}', "whole"), ('{"1": 50}', "between"), ('{"1": 20}', "not an")):
        (tmp_path / "map.json").write_text(text)
        with pytest.raises(InputError, match=f"map.json.*{said}"):
            Labelling(label_map=tmp_path / "map.json").fdi(tmp_path / "jaw.ply", LOWER.face_labels, LOWER.mesh)
    (tmp_path / "map.json").write_text('{"101": 37}')
    with pytest.raises(InputError, match=r"jaw.ply: --label-map does not say what label 102 is"):
        load_jaw(tmp_path / "jaw.ply", labelling=Labelling(label_map=tmp_path / "map.json"))


@pytest.mark.long
@pytest.mark.parametrize("name", ["jaw_lower.ply", "jaw.ply"])
def test_the_verb_measures_the_right_teeth(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    """Labels 1-14 of a lower jaw were measured as upper teeth from 12 to 24."""
    labels = replaced(LOWER.face_labels, ALONG)
    storage.write_mesh(tmp_path / name, LOWER.mesh.transformed(any_pose(0, 40)), labels)
    arguments = ["jaw", "measure", str(tmp_path / name), "--out", str(tmp_path / "out")]
    if name == "jaw.ply":
        with pytest.raises(SystemExit):
            main(arguments)
        assert "give --arch lower or upper" in " ".join(capsys.readouterr().err.split())
        arguments += ["--arch", "lower"]
    main(arguments)
    assert storage.read_json(tmp_path / "out" / "measure.json")["jaws"][0]["group"] == "Lower-14"
