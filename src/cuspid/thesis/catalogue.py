"""The tables, figures and equations of the thesis (Ghanoum 2021): what its text still says of each, in our own words.

The pictures, Tables 1.1 and 3.1 and the list of references are lost in our copy; captions and text are there. Teeth are
numbered as in FDI; the thesis uses the Universal numbers (46 is 30, 45 is 29, 42 is 26, 35 is 20, 36 is 19).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal["figure", "table", "equation"]


@dataclass(frozen=True, kw_only=True)
class Item:
    """One table, figure or equation."""

    id: str
    """As the command line takes it: fig-2.5, table-3.2, eq-3.9."""
    section: str
    """Of the thesis."""
    title: str
    """What it shows, in our own words."""
    states: str
    """What the thesis states with it."""
    lost: str = ""
    """Why nothing can be compared, where nothing can."""
    pictures: tuple[tuple[str, str], ...] = ()
    """Files of ours that show the same, and what is in them."""

    @property
    def kind(self) -> Kind:
        """By the id."""
        return {"fig": "figure", "table": "table", "eq": "equation"}[self.id.split("-")[0]]  # type: ignore[return-value]

    @property
    def name(self) -> str:
        """For headings."""
        kind, number = self.id.split("-")
        return f"{ {'fig': 'Fig', 'table': 'Table', 'eq': 'Eq'}[kind] } {number}"


@dataclass(frozen=True, kw_only=True)
class TruenessRow:
    """A row of Table 3.2, absolute deviations in um."""

    part: str
    """Its letter in the table."""
    tooth: int | None
    """FDI number; None for the complete arch."""
    what: str
    """What was done to the tooth."""
    min_um: float
    max_um: float
    mean_um: float
    std_um: float

    @property
    def result(self) -> str:
        """Name of our results."""
        return f"prepared-{self.tooth or 'arch'}"


def _row(part: str, tooth: int | None, what: str, *um: int) -> TruenessRow:
    least, largest, mean, std = map(float, um)
    return TruenessRow(part=part, tooth=tooth, what=what, min_um=least, max_um=largest, mean_um=mean, std_um=std)


TABLE_3_2 = (
    _row("B", 46, "cracked", 23, 211, 130, 100),
    _row("C", 45, "crown", 34, 230, 74, 86),
    _row("D", 42, "full-contour crown", 27, 188, 61, 50),
    _row("E", 35, "MOD inlay", 26, 290, 135, 121),
    _row("F", 36, "MOD inlay", 26, 285, 120, 96),
    _row("A", None, "complete arch", 60, 590, 280, 200),
)
"""As printed."""

_PICTURE = "A photograph or drawing that is lost in our copy; the text gives no number with it."

ITEMS: tuple[Item, ...] = (
    Item(
        id="fig-1.1",
        section="1.1",
        title="Dental impressions",
        states="Optical impressions spare the patient trays and materials.",
        lost=_PICTURE,
    ),
    Item(
        id="fig-1.2",
        section="1.1.1",
        title="The margin line of prepared teeth",
        states="Deep margin lines are hard for optical impressions to find. No number.",
        lost=_PICTURE,
        pictures=(("preparation-thesis-reference.png", "Prepared teeth of our reference model with their margins"),),
    ),
    Item(
        id="fig-1.3",
        section="1.2",
        title="Matches of features between the two images of a stereo pair",
        states="On teeth, which have few features, only few matches are found, right and wrong ones.",
    ),
    Item(
        id="fig-2.1",
        section="2.1.1",
        title="The way of the incisors, the angle of opening and the distance from condyle to incisors",
        states="The jaw turns by 26 ± 7 deg on average at maximal opening (93 people), taken as 0.45 rad.",
    ),
    Item(
        id="fig-2.2",
        section="2.2",
        title="Dimensions of a dental arch: a (canines), b (first molars), c (second molars), f (length)",
        states="Definitions of the four distances.",
        pictures=(("landmarks-dimensions.png", "a, b, c and f measured on a phantom"),),
    ),
    Item(
        id="fig-2.3",
        section="2.2",
        title="Landmarks of a jaw",
        states="72 landmarks on a jaw of 14 teeth.",
        pictures=(("landmarks-scheme.png", "Our scheme of 72 landmarks"),),
    ),
    Item(
        id="fig-2.4",
        section="2.2.1",
        title="Measures of the ramus",
        states="Mean height of the ramus 49.23 ± 7.22 mm (910 patients of another study).",
        lost="A drawing of another study's measures, lost in our copy. Its 49.23 mm enter Eq 2.2; we have no patients "
        "to measure it on.",
    ),
    Item(
        id="fig-2.5",
        section="2.2.1",
        title="The sagittal plane: opening, second molar, the gap L",
        states="Geometry of Eq 2.2 to 2.4.",
        pictures=(("mouth-sagittal.png", "The mean mouth of women in our model, to scale"),),
    ),
    Item(
        id="fig-2.6",
        section="2.2.1",
        title="The smallest room that the handpiece has to reach into",
        states="About 5 mm are left between the cameras and the teeth.",
        pictures=(("mouth-fit.png", "Share of people whom a handpiece fits, by the room that it needs"),),
    ),
    Item(
        id="fig-3.1",
        section="3.1",
        title="How an image is formed",
        states="A point is where its ray through the camera meets the image plane.",
    ),
    Item(
        id="fig-3.2",
        section="3.1",
        title="The parameters of a camera",
        states="A projective camera has 11 parameters, intrinsic and extrinsic.",
    ),
    Item(
        id="fig-3.3",
        section="3.1",
        title="Orthographic against perspective projection",
        states="Perspective shows what is farther away smaller; orthographic projection does not.",
    ),
    Item(
        id="fig-3.4",
        section="3.2",
        title="Corresponding points lie on epipolar lines",
        states="The match of x lies on the line l' in the other image.",
    ),
    Item(
        id="fig-3.5",
        section="3.3.1",
        title="How the fundamental matrix maps a point to a line",
        states="Through a plane: x to x' by a homography, x' and the epipole to l'.",
    ),
    Item(
        id="fig-3.6",
        section="3.3.3",
        title="Baseline, angle of the axes and distance of a pair of cameras",
        states="The three parameters to be chosen.",
    ),
    Item(
        id="fig-3.7",
        section="3.3.3",
        title="A pair of 5 mm and 12 deg, 8 mm from a second molar",
        states="Windows around corresponding points do not show the same surface: matching suffers.",
    ),
    Item(
        id="fig-3.8",
        section="3.4",
        title="The setting of the binocular analysis",
        states="Two cameras at a baseline, a point on a circle around its middle.",
    ),
    Item(
        id="fig-3.9",
        section="3.4",
        title="A virtual pair before part of a second molar",
        states="Baseline 1 to 4 mm, angle 10 to 40 deg, distance 13 to 3 mm.",
    ),
    Item(
        id="fig-3.10",
        section="3.4",
        title="The best poses of the pair",
        states="A smaller baseline is more accurate; a smaller distance needs a larger angle.",
        pictures=(("camera-pair-best.png", "Best baseline over the distance, for each angle of the axes"),),
    ),
    Item(
        id="fig-3.11",
        section="3.5",
        title="Reconstruction of a scene from photographs",
        states="An example of structure from motion on another scene.",
        lost="A picture of another scene, lost in our copy; the text gives no number with it.",
    ),
    Item(
        id="fig-3.12",
        section="3.5",
        title="The steps of incremental structure from motion",
        states="Correspondences, then registration, triangulation and bundle adjustment.",
        lost="A diagram that is lost in our copy. The steps of ours are in docs/architecture.md; its errors are those "
        "of Table 3.2.",
    ),
    Item(
        id="fig-3.13",
        section="3.5.1",
        title="The surfaces of the teeth on which pairs are tested",
        states="Occlusal, incisal, buccal, lingual, labial, distal, mesial and gingival; the pairs that are best for "
        "the top surfaces also suit the buccal, lingual and gingival ones (3.5.2).",
        pictures=(("visibility-twelve.png", "The surfaces, and what twelve cameras see of them"),),
    ),
    Item(
        id="fig-3.14",
        section="3.5.1",
        title="The best pair over the occlusal and the incisal surface",
        states="Of baselines 1 to 4 mm and angles 0 to 9 deg, 2.5 mm and 0 deg is best over the occlusal surface, 1.5 "
        "mm and 0 deg over the incisal one (512 px, 62 deg, 5 mm).",
        pictures=(("sweep-occlusal.png", "Our sweep over the occlusal surface"),),
    ),
    Item(
        id="fig-3.15",
        section="3.5.2",
        title="The design with twelve cameras",
        states="Three groups of four, each for one of the main surfaces of a tooth.",
        pictures=(("design-twelve.png", "The twelve cameras of our design"),),
    ),
    Item(
        id="fig-3.16",
        section="3.5.3.1",
        title="The mean shape of the jaws",
        states="Found by thin-plate splines in a few iterations.",
        pictures=(("shape-mean.png", "The mean of phantoms drawn from Table 2.1"),),
    ),
    Item(
        id="fig-3.17",
        section="3.5.3.2",
        title="The mean shape with a box for each tooth",
        states="Each tooth becomes a box of its own size.",
        pictures=(("shape-boxed.png", "The boxed mean jaw"),),
    ),
    Item(
        id="fig-3.18",
        section="3.5.3.2",
        title="The design with six cameras scans the cross section of a tooth",
        states="It is turned at least three times; two cameras stand 2 mm beside the essential four.",
        pictures=(("design-six.png", "The six cameras of our design"),),
    ),
    Item(
        id="fig-3.19",
        section="3.5.3.2",
        title="The boxed jaw, reconstructed with six cameras",
        states="Good quality and quantity; the essential four with three turns are not enough.",
    ),
    Item(
        id="fig-3.20",
        section="3.6",
        title="The reference model with prepared teeth",
        states="46 cracked, 45 prepared for a crown, 42 for a full-contour crown, 35 and 36 for MOD inlays.",
        pictures=(("preparation-thesis-reference.png", "Our reference model"),),
    ),
    Item(
        id="fig-3.21",
        section="3.6",
        title="Five teeth, reconstructed, with colour maps of their RMS error",
        states="The maps are lost; the RMS follows from mean and SD of Table 3.2.",
        pictures=(
            ("molar-deviation.png", "A molar of our phantom, scanned by twelve cameras"),
            ("prepared-46.png", "B, the cracked tooth, scanned by twelve cameras"),
            ("prepared-36.png", "F, an inlay, scanned by twelve cameras"),
        ),
    ),
    Item(
        id="fig-3.22",
        section="3.6",
        title="The complete arch, reconstructed, with a colour map of its RMS error",
        states="The map is lost; the RMS follows from mean and SD of Table 3.2.",
        pictures=(("prepared-arch.png", "The arch, scanned by twelve cameras"),),
    ),
    Item(
        id="fig-4.1",
        section="4.1",
        title="The steps of the panorama; normal maps from shading",
        states="Normal maps are rich in features where images are not; KAZE finds more in them than SIFT.",
        pictures=(("panorama-thesis-maps.png", "Frames, normals, normal maps, features and segments of ours"),),
    ),
    Item(
        id="fig-4.2",
        section="4.1.1",
        title="A restricted and an unrestricted camera path",
        states="The hand changes the distance to the teeth as it goes.",
    ),
    Item(
        id="fig-4.3",
        section="4.1.1",
        title="Three frames that the examination refuses",
        states="For translation, for shearing, and for scale together with translation.",
    ),
    Item(
        id="fig-4.4",
        section="4.3",
        title="Likeness of the panorama to the true jaw, ten subjects",
        states="SSIM above 0.70 for the proposed method. (The text speaks of eight jaws.)",
        pictures=(("reproduction-fig-4.4.png", "SSIM over the whole canvas by subject"),),
    ),
    Item(
        id="fig-4.5",
        section="4.3",
        title="Panoramas with and without the examination of frames",
        states="With it the panorama is much better, and better than that of an automatic stitcher.",
        pictures=(
            ("panorama-thesis-parts.png", "Parts of a panorama with (upper row) and without the examination"),
            ("panorama-lower-14-0-thesis.png", "The thesis' method, with the examination"),
            ("panorama-lower-14-0-thesis-unexamined.png", "The thesis' method, without the examination"),
            ("panorama-lower-14-0-ortho.png", "Our default method"),
        ),
    ),
    Item(
        id="table-1.1",
        section="1.3",
        title="Technical data of intra-oral scanners",
        states="A comparison of commercial scanners.",
        lost="The table is lost in our copy; the text around it has no figures of accuracy. We have none of the "
        "scanners.",
    ),
    Item(
        id="table-2.1",
        section="2.2",
        title="Arch dimensions a, b, c and f of 432 CT models in four groups",
        states="Means and SD in mm. Column f repeats column b to 0.06 mm.",
    ),
    Item(
        id="table-3.1",
        section="3.5.4",
        title="Six cameras against twelve",
        states="The table is lost. The text: the twelve are the more plausible design, moved only; many cameras make "
        "time and error small (3.5.2).",
        pictures=(("design-comparison.png", "Size, completeness and error of both, and of other designs"),),
    ),
    Item(
        id="table-3.2",
        section="3.6",
        title="Trueness of five prepared teeth and of the complete arch",
        states="Twelve cameras, 120 images a tooth, 1200 for the arch, textured; line distance at few points.",
        pictures=(("reproduction-table-3.2.png", "Mean deviations of the thesis and ours, logarithmic scale"),),
    ),
    Item(id="eq-2.1", section="2.1.1", title="r = C / theta", states="r = 77.7 to 134 mm for C = 35 to 60 mm."),
    Item(id="eq-2.2", section="2.2.1", title="alpha = sin(RH / r), meant: arcsin", states="alpha = 21 to 39 deg."),
    Item(id="eq-2.3", section="2.2.1", title="d = r - f cos(alpha)", states="Distance of the second molar. No number."),
    Item(id="eq-2.4", section="2.2.1", title="L = d theta", states="L = 12 to 26.6 mm."),
    Item(
        id="eq-3.1",
        section="3.1",
        title="x = f X / Z, y = f Y / Z",
        states="Printed for orthographic projection; it is the perspective one.",
    ),
    Item(id="eq-3.2", section="3.1", title="P = K [R | t]", states="The projection matrix."),
    Item(id="eq-3.3", section="3.3", title="x to l'", states="A point is mapped to a line."),
    Item(
        id="eq-3.4",
        section="3.3.1",
        title="l' = [e']x H x = F x",
        states="Printed without the skew matrix, and with F behind x.",
    ),
    Item(id="eq-3.5", section="3.3.2", title="F = [e']x P' P+", states="Printed without the skew matrix."),
    Item(id="eq-3.6", section="3.3.3", title="x'T F x = 0", states="Printed without the transposition."),
    Item(id="eq-3.7", section="3.4", title="x = P X = K [R | t] X", states="The projection of a point."),
    Item(id="eq-3.8", section="3.4", title="The likelihood of the image points", states="Normal noise in the images."),
    Item(
        id="eq-3.9",
        section="3.4",
        title="The Cramer-Rao bound of a pair",
        states="A closed form, in which the exponents 4 of the depths are printed as 1.",
    ),
)
"""In the order of the page: figures, tables, equations."""

BY_ID = {item.id: item for item in ITEMS}
