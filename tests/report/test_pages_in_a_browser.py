"""Pages in a real browser: what is drawn, what buttons do, and that nothing is asked of a network."""

from __future__ import annotations

import base64
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from cuspid import cli, storage
from cuspid.model.jaw import Jaw
from cuspid.model.panorama import Panorama
from panoramas import stitched_panorama
from report_folders import tooth_alone, write_comparison, write_scan, write_score, write_shape

sync_api = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed: pip install playwright")
pytestmark = pytest.mark.long

ARGUMENTS = (
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
LAPTOP, PHONE = {"width": 1366, "height": 768}, {"width": 390, "height": 844}
A4 = {"width": 695, "height": 1017}
"""What the margins of the paper leave, in CSS px."""
READY_MS = 60_000
ARE_WIDE = """width => [...document.querySelectorAll('.zoomed img')].map((each) =>
  each.getBoundingClientRect().width > width).reduce((one, other) => one === other ? one : null)"""
"""Whether all pictures are wider, or none is; null in between, for one follows the other a frame later."""
PICTURE = """async () => {
  for (let k = 0; k < 3; k++) await new Promise((done) => requestAnimationFrame(done));
  return document.querySelector("canvas").toDataURL("image/png").split(",")[1];
}"""


STOP = """() => {
  const each = document.activeElement;
  if (!each || each === document.body) return null;
  const name = each.ariaLabel || each.labels?.[0]?.textContent || each.textContent;
  const { outlineStyle, outlineWidth } = getComputedStyle(each);
  return { tag: each.tagName, name: name.trim(), outline: outlineStyle === "none" ? 0 : parseFloat(outlineWidth) };
}"""
"""What the keyboard is at, None past the end of the page."""


@dataclass
class Visit:
    """A page that was opened, and what the browser said meanwhile."""

    page: object
    complaints: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def picture(self) -> np.ndarray:
        """What the viewer shows, after it was drawn; without the labels and bars that lie over it."""
        return decoded(self.page.evaluate(PICTURE))

    def settle(self) -> None:
        """Wait until what was asked of the view is drawn."""
        self.page.evaluate(PICTURE)

    def press(self, selector: str) -> None:
        self.page.locator(selector).first.click()


def decoded(base64_png: str) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(base64.b64decode(base64_png), np.uint8), cv2.IMREAD_UNCHANGED)


def differing(one: np.ndarray, other: np.ndarray) -> float:
    """Share of the pixels that differ visibly."""
    return float(np.mean(np.abs(one.astype(int) - other.astype(int)).max(axis=2) > 8))


@pytest.fixture(scope="module")
def browser() -> Iterator[object]:
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None:
        pytest.skip("no Chromium here; on Debian: apt-get install chromium")
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=found, headless=True, args=list(ARGUMENTS))
        yield chromium
        chromium.close()


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory, coarse_phantom: Jaw) -> dict[str, Path]:
    """Reports, by what they are of."""
    folder = tmp_path_factory.mktemp("reports")
    write_scan(folder / "scan", coarse_phantom)
    write_shape(folder / "shape", tooth_alone(coarse_phantom))
    write_score(folder / "score")
    write_comparison(folder / "comparison")
    names = ("scan", "shape", "score", "comparison")
    for name in names:
        cli.main(["report", str(folder / name)])
    return {name: folder / name / "report.html" for name in names}


def visit(browser, path: Path, *, viewer: bool = True, before: str | None = None, **context) -> Visit:
    page = browser.new_context(**{"viewport": LAPTOP, "offline": True, **context}).new_page()
    found = Visit(page)
    page.on("console", lambda message: found.complaints.append(message.text))
    page.on("pageerror", lambda error: found.complaints.append(str(error)))
    page.on("request", lambda request: found.requests.append(request.url))
    if before:
        page.add_init_script(before)
    page.goto(path.as_uri())
    if viewer:
        page.wait_for_selector("#viewer[data-ready]", state="attached", timeout=READY_MS)
    return found


@pytest.fixture(scope="module")
def scan(browser, pages) -> Iterator[Visit]:
    found = visit(browser, pages["scan"])
    yield found
    found.page.context.close()


@pytest.fixture
def fresh(scan: Visit) -> Visit:
    """The page of the scan as it was when it was opened."""
    for button in scan.page.locator("#viewer [data-layer], #viewer [data-colors], #viewer [data-teeth]").all():
        wanted = "true" if button.inner_text() in ("Scan", "Deviation") else "false"
        if button.get_attribute("aria-pressed") != wanted:
            button.click()
    scan.press("[data-reset]")
    scan.settle()
    return scan


def test_the_surface_is_drawn(fresh):
    seen = fresh.picture()
    fresh.press("[data-layer=scan]")
    empty = fresh.picture()
    assert 0.1 < differing(seen, empty) < 0.9
    assert empty[..., 3].max() == 0, "without a layer there is only the background"


def test_it_fills_the_view_but_not_more(fresh):
    rows, columns = np.nonzero(fresh.picture()[..., 3])
    height, width = fresh.picture().shape[:2]
    assert 0.8 < max(np.ptp(rows) / height, np.ptp(columns) / width) < 1
    assert min(rows.min(), columns.min()) > 0
    assert rows.max() < height - 1


def test_colours_are_those_of_the_deviation(fresh):
    """The bump is red, the rest green; without colours it is plaster."""
    blue, green, red = np.moveaxis(fresh.picture()[..., :3].astype(int), 2, 0)
    assert 0.0005 < np.mean((red > green + 60) & (red > blue + 60)) < 0.05
    assert np.mean((green > red + 30) & (green > blue + 30)) > 0.1
    fresh.press("[data-colors=deviation]")
    blue, green, red = np.moveaxis(fresh.picture()[..., :3].astype(int), 2, 0)
    assert np.abs(red - green).max() < 40


def test_colours_are_those_of_what_was_expected_when_that_is_chosen(fresh):
    """It grows along X, from blue to yellow; grey is not known."""
    deviation = fresh.picture()
    fresh.press("[data-colors=sigma]")
    picture = fresh.picture()
    assert differing(deviation, picture) > 0.1
    blue, green = np.moveaxis(picture[..., :2].astype(int), 2, 0)
    _, left = np.nonzero((blue > green + 20) & (picture[..., 3] == 255))
    _, right = np.nonzero((green > blue + 40) & (picture[..., 3] == 255))
    assert np.median(left) < np.median(right) - 50
    legend = fresh.page.locator(".legend:visible")
    assert "standard deviation" in legend.inner_text()
    ticks = [float(each) for each in legend.locator(".ticks span").all_inner_texts()]
    assert ticks == [0, 1.25, 2.5, 3.75, 5]
    legend.locator("[data-range]").select_option("100.0")
    assert legend.locator(".ticks span").last.inner_text() == "100"
    assert differing(picture, fresh.picture()) > 0.1
    legend.locator("[data-range]").select_option("5.0")
    assert differing(picture, fresh.picture()) == 0
    fresh.press("[data-colors=deviation]")
    assert differing(deviation, fresh.picture()) == 0
    assert "positive outside" in fresh.page.locator(".legend:visible").inner_text()


def test_what_was_expected_is_read_where_one_clicks(fresh):
    fresh.press("[data-colors=sigma]")
    box = fresh.page.locator("canvas").bounding_box()
    fresh.page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    text = fresh.page.locator(".readout").inner_text()
    assert text.startswith("not known") or 1 < float(re.match(r"[\d.]+", text)[0]) < 4, "without a sign"
    fresh.press("[data-colors=deviation]")
    assert fresh.page.locator(".readout").is_hidden(), "it was read off other colours"


def test_turning_changes_the_picture_and_reset_brings_it_back(fresh):
    before = fresh.picture()
    box = fresh.page.locator("canvas").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    fresh.page.mouse.move(x, y)
    fresh.page.mouse.down()
    fresh.page.mouse.move(x + 120, y + 60, steps=6)
    fresh.page.mouse.up()
    assert differing(before, fresh.picture()) > 0.05
    fresh.press("[data-reset]")
    assert differing(before, fresh.picture()) < 0.002


def test_the_keys_turn_move_zoom_and_read(fresh):
    """Each key and its opposite leave the view as it was; the arrow to the right moves the surface there."""
    fresh.page.locator("canvas").focus()

    def typed(*keys: str) -> np.ndarray:
        for key in keys:
            fresh.page.keyboard.press(key)
        return fresh.picture()

    def middle(picture: np.ndarray) -> float:
        return float(np.nonzero(picture[..., 3])[1].mean())

    before = fresh.picture()
    for key, opposite in (("ArrowRight", "ArrowLeft"), ("ArrowUp", "ArrowDown"), ("+", "-")):
        assert differing(before, typed(key)) > 0.02
        assert differing(before, typed(opposite)) < 0.002
    moved = typed("Shift+ArrowRight")
    assert 0.05 < (middle(moved) - middle(before)) / before.shape[0] < 0.2
    assert differing(before, typed("Shift+ArrowLeft")) < 0.002
    typed("+", "ArrowUp")
    assert differing(before, typed("0")) < 0.002
    typed("Enter")
    assert "µm" in fresh.page.locator(".readout").inner_text()


def test_the_wheel_zooms_and_the_length_bar_follows(fresh):
    def millimetres_per_px() -> float:
        length = float(fresh.page.locator(".length b").inner_text().split()[0])
        return length / fresh.page.locator(".length span").bounding_box()["width"]

    before = millimetres_per_px()
    fresh.page.locator("canvas").hover()
    fresh.page.mouse.wheel(0, -400)
    fresh.settle()
    assert millimetres_per_px() < 0.9 * before


@pytest.mark.parametrize("layer", ["scan", "reference", "cameras", "path"])
def test_layers_are_toggled(fresh, layer):
    before = fresh.picture()
    fresh.press(f"[data-layer={layer}]")
    assert differing(before, fresh.picture()) > 1e-4
    fresh.press(f"[data-layer={layer}]")
    assert differing(before, fresh.picture()) == 0


@pytest.mark.parametrize("layer", ["reference", "cameras"])
def test_a_standard_view_fits_what_is_shown_and_a_turned_one_stays(fresh, layer):
    fresh.press(f"[data-layer={layer}]")
    fitted = fresh.picture()[..., 3]
    assert fitted.max() == 255
    assert max(fitted[0].max(), fitted[-1].max(), fitted[:, 0].max(), fitted[:, -1].max()) == 0
    fresh.page.locator("canvas").hover()
    fresh.page.mouse.wheel(0, -400)
    fresh.settle()
    length = fresh.page.locator(".length span").bounding_box()["width"], fresh.page.locator(".length b").inner_text()
    fresh.press(f"[data-layer={layer}]")
    fresh.settle()
    assert length == (
        fresh.page.locator(".length span").bounding_box()["width"],
        fresh.page.locator(".length b").inner_text(),
    )


@pytest.mark.parametrize("view", ["Front", "Right", "Left", "Behind"])
def test_standard_views_differ_from_the_occlusal_one(fresh, view):
    before = fresh.picture()
    fresh.press(f"[data-view={view}]")
    assert differing(before, fresh.picture()) > 0.03
    fresh.press("[data-view=Occlusal]")
    assert differing(before, fresh.picture()) < 0.002


def test_the_range_changes_colours_and_the_legend(fresh):
    before, ticks = fresh.picture(), fresh.page.locator(".ticks:visible").inner_text()
    chosen = fresh.page.locator("[data-range]:visible").input_value()
    fresh.page.select_option("[data-range]:visible", "500.0")
    assert "+500" in fresh.page.locator(".ticks:visible").inner_text()
    assert differing(before, fresh.picture()) > 0.001
    fresh.page.select_option("[data-range]:visible", chosen)
    assert fresh.page.locator(".ticks:visible").inner_text() == ticks


def test_the_worst_place_is_the_bump_and_the_view_goes_there(fresh):
    before = fresh.page.locator(".length b").inner_text()
    fresh.press("[data-worst='0']")
    fresh.settle()
    assert fresh.page.locator(".length b").inner_text() != before
    box = fresh.page.locator("canvas").bounding_box()
    fresh.page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    value = float(re.match(r"[+−]?[\d.]+", fresh.page.locator(".readout").inner_text())[0])
    assert 60 < value < 90


def test_a_frame_shows_where_its_cameras_were(fresh):
    fresh.press("[data-view=Front]")
    before = fresh.picture()
    fresh.press("[data-frame='00000']")
    assert differing(before, fresh.picture()) > 1e-4


def test_tooth_numbers_lie_over_the_teeth(fresh):
    fresh.press("[data-teeth]")
    fresh.settle()
    label = fresh.page.locator(".teeth span")
    assert label.inner_text() == "46"
    box, canvas = label.bounding_box(), fresh.page.locator("canvas").bounding_box()
    assert canvas["x"] < box["x"] < canvas["x"] + canvas["width"]
    assert canvas["y"] < box["y"] < canvas["y"] + canvas["height"]


def test_nothing_is_complained_of_and_nothing_asked_of_a_network(scan, pages):
    """Runs after the others of this page, which have pressed every button."""
    assert scan.complaints == []
    assert {url for url in scan.requests if not url.startswith(("data:", "blob:"))} == {pages["scan"].as_uri()}


def test_on_paper_the_view_is_a_picture_and_settings_are_open(fresh):
    fresh.page.wait_for_timeout(600)
    fresh.page.emulate_media(media="print")
    shown = fresh.page.locator(".still")
    assert shown.is_visible()
    assert not fresh.page.locator("canvas").is_visible()
    assert not fresh.page.locator(".toolbar").is_visible()
    fresh.page.evaluate("dispatchEvent(new Event('beforeprint'))")
    still = decoded(shown.get_attribute("src").split(",")[1])
    assert 0.05 < np.mean(still[..., 3] > 0) < 0.95
    length_bar = still[-25:-10, 14:30]
    assert (length_bar.min(axis=2) == 0).any(), "transparent around it"
    assert ((length_bar[..., 3] == 255) & (length_bar[..., :3].max(axis=2) < 30)).any(), "black"
    document = fresh.page.pdf(format="A4", print_background=True)
    fresh.page.emulate_media(media="screen")
    assert document.startswith(b"%PDF")
    assert 1 <= len(re.findall(rb"/Type\s*/Page\b", document)) <= 5


def test_a_wide_table_fits_on_paper_and_is_moved_on_a_screen(browser, pages):
    study = visit(browser, pages["comparison"], viewer=False, viewport=A4)
    reach = "document.querySelector('.sorted').getBoundingClientRect().right"
    columns = study.page.locator(".sorted thead th")
    assert study.page.evaluate(reach) > A4["width"]
    assert study.page.evaluate("document.documentElement.scrollWidth") <= A4["width"]
    assert columns.last.is_visible()
    study.page.emulate_media(media="print")
    assert study.page.evaluate(reach) <= A4["width"]
    assert not columns.last.is_visible()
    assert f"of {columns.count()} columns" in study.page.locator(".sorted caption").inner_text()
    study.page.context.close()


def test_tables_are_sorted_and_moved_by_the_keys(browser, pages):
    study = visit(browser, pages["comparison"], viewer=False, viewport=PHONE)
    head = study.page.locator(".sorted thead th").nth(1)
    for order in ("ascending", "descending"):
        head.locator("button").focus()
        study.page.keyboard.press("Enter")
        assert head.get_attribute("aria-sort") == order
    box = study.page.locator(".scroll", has=study.page.locator(".sorted"))
    study.page.wait_for_selector(".scroll[aria-label='All cases'][tabindex]")
    box.focus()
    study.page.keyboard.press("ArrowRight")
    study.page.wait_for_function("() => document.querySelector('.scroll:focus').scrollLeft > 0")
    study.page.context.close()


def test_every_control_has_a_name_and_shows_where_the_keyboard_is(browser, pages):
    """Of every kind of page, in the dark, where the page is dark and what is drawn is not."""
    for name, path in pages.items():
        found = visit(browser, path, viewer=name in ("scan", "shape"), color_scheme="dark")
        assert found.page.locator("main, header, footer").count() == 3
        stops = 0
        while (stop := (found.page.keyboard.press("Tab"), found.page.evaluate(STOP))[1]) and stops < 100:
            assert stop["name"], stop
            assert stop["outline"] >= 2, stop
            stops += 1
        assert stops > 3
        assert (
            max(found.page.evaluate("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)")) < 60
        )
        found.page.context.close()


def test_on_a_phone(browser, pages):
    phone = visit(browser, pages["scan"], viewport=PHONE, has_touch=True, is_mobile=True, device_scale_factor=2)
    assert phone.page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    assert 0.05 < np.mean(phone.picture()[..., 3] > 0) < 0.95
    box = phone.page.locator("canvas").bounding_box()
    assert box["height"] < 0.75 * PHONE["height"], "the page can still be moved by a finger beside the view"
    phone.page.touchscreen.tap(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    assert "µm" in phone.page.locator(".readout").inner_text()
    phone.press("[data-colors=sigma]")
    assert "standard deviation" in phone.page.locator(".legend:visible").inner_text()
    assert phone.page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    assert phone.complaints == []
    phone.page.context.close()


PLACED = """() => {
  const around = document.querySelector(".zoomed").getBoundingClientRect();
  const picture = document.querySelector(".zoomed img").getBoundingClientRect();
  return [...document.querySelectorAll(".marks circle")].map((dot) => [
    (Number(dot.getAttribute("cx")) + around.left - picture.left) / picture.width,
    (Number(dot.getAttribute("cy")) + around.top - picture.top) / picture.height]);
}"""
"""Where the marks are, as shares of the picture."""


def test_two_clicks_on_a_panorama_measure_and_tell_how_to_scale_it(browser, tmp_path):
    shown = write_wide(tmp_path / "pano 1")
    cli.main(["report", str(tmp_path / "pano 1")])
    visited = visit(browser, tmp_path / "pano 1" / "report.html", viewer=False)
    page, output = visited.page, visited.page.locator("[data-measures] output")
    page.locator(".zoomed img[style*=width]").wait_for()
    box = page.locator(".zoomed img").bounding_box()

    def at(across: float, down: float) -> tuple[float, float]:
        return box["x"] + across * box["width"], box["y"] + down * box["height"]

    page.mouse.click(*at(0.2, 0.3))
    assert not output.is_visible()
    page.mouse.move(*at(0.5, 0.5))
    page.mouse.down()
    page.mouse.move(*at(0.52, 0.5), steps=4)
    page.mouse.up()
    page.locator("[data-zoom=reset]").first.click()
    page.wait_for_timeout(200)
    assert len(page.evaluate(PLACED)) == 1, "to move the picture marks nothing"
    page.mouse.click(*at(0.8, 0.7))
    height, width = shown.covered.shape
    mm = shown.mm_per_px * np.hypot(0.6 * width, 0.4 * height)
    told = output.inner_text()
    assert float(told.split(" mm")[0]) == pytest.approx(mm, rel=0.02)
    command = re.search(r"cuspid pano rescale 'pano 1' --distance ([\d. ]+) MM --out 'pano 1-mm'", told)
    pixels = np.array(command[1].split(), float).reshape(2, 2)
    np.testing.assert_allclose(pixels, [[0.2 * width, 0.3 * height], [0.8 * width, 0.7 * height]], atol=3)
    placed = np.array(page.evaluate(PLACED))
    page.locator("[data-zoom=in]").first.click()
    page.wait_for_timeout(200)
    np.testing.assert_allclose(page.evaluate(PLACED), placed, atol=0.005)
    page.mouse.dblclick(*at(0.5, 0.5))
    assert page.evaluate(PLACED) == []
    assert not output.is_visible()
    assert visited.complaints == []
    page.context.close()


def write_wide(folder: Path) -> Panorama:
    """A panorama of 400 x 300 px; a click on it is as exact as a pixel of the screen."""
    small = stitched_panorama()
    shape, columns = (300, 400), np.arange(400, dtype=np.float32)
    wide = replace(
        small,
        image=np.full((*shape, 3), 90, np.uint8),
        covered=np.ones(shape, bool),
        frame_index=np.zeros(shape, np.int16),
        frame_pixel=np.zeros((*shape, 2), np.float32),
        height_mm=np.broadcast_to(columns, shape).copy(),
    )
    storage.write_panorama(folder, wide)
    return wide


def test_the_thesis_beside_ours_is_read_on_a_phone(browser, tmp_path):
    results = Path(__file__).parents[2] / "benchmarks" / "results"
    cli.main(
        ["reproduce", "--no-run", "--only", "fig-4.4", "table-3.2", "--results", str(results), "--out", str(tmp_path)]
    )
    phone = visit(browser, tmp_path / "reproduction.html", viewer=False, viewport=PHONE, is_mobile=True)
    assert phone.page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    cells = phone.page.locator(".plain td").all()
    assert len(cells) > 10
    for cell in cells:
        box = cell.bounding_box()
        assert box["width"] > 0.7 * PHONE["width"], "long names do not squeeze what stands beside them"
        assert box["height"] < PHONE["height"]
    assert phone.complaints == []
    phone.page.context.close()


def test_without_webgl_a_picture_is_shown(browser, pages):
    blind = "HTMLCanvasElement.prototype.getContext = () => null;"
    found = visit(browser, pages["scan"], viewer=False, before=blind)
    found.page.locator(".loading", has_text="picture").wait_for()
    assert found.page.locator(".still").is_visible()
    assert "46" in found.page.locator("table.figures").first.inner_text()
    found.page.context.close()


def test_modes_bend_the_mean(browser, pages):
    shape = visit(browser, pages["shape"])
    before = shape.picture()
    shape.page.locator("[data-mode='0']").fill("2")
    bent = shape.picture()
    assert differing(before, bent) > 0.05
    assert shape.page.locator("output").first.inner_text() == "+2 SD"
    shape.press("[data-mean]")
    assert differing(before, shape.picture()) < 0.002
    assert shape.complaints == []
    shape.page.context.close()


def test_pictures_zoom_together(browser, pages):
    score = visit(browser, pages["score"], viewer=False)
    score.page.locator(".zoomed img[style*=width]").nth(1).wait_for()
    widths = [image.bounding_box()["width"] for image in score.page.locator(".zoomed img").all()]
    score.page.locator(".zoomed").first.hover()
    score.page.mouse.wheel(0, -300)
    score.page.wait_for_function(ARE_WIDE, arg=1.1 * widths[0])
    zoomed = [image.bounding_box()["width"] for image in score.page.locator(".zoomed img").all()]
    assert all(after > 1.1 * before for before, after in zip(widths, zoomed, strict=True))
    assert zoomed[0] == pytest.approx(zoomed[1])
    score.press("[data-zoom=reset]")
    score.page.wait_for_function(f"width => ({ARE_WIDE})(width) === false", arg=1.01 * widths[0])
    assert score.page.locator(".zoomed img").first.bounding_box()["width"] == pytest.approx(widths[0], rel=0.01)
    assert score.complaints == []
    assert all(url == pages["score"].as_uri() or url.startswith("data:") for url in score.requests)
    score.page.context.close()
