"""A holder to be printed: one closed piece, seats that modules go into, nothing in the way, walls as asked for."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from manifold3d import Manifold, OpType

from cuspid import storage
from cuspid.geometry import Rigid3
from cuspid.handpiece.cad.holder import HolderOptions
from cuspid.handpiece.cad.printability import check_printable, check_seats, check_sight, check_solid, thinnest
from cuspid.handpiece.cad.printable import Printable, block, make_rounded_box, printable
from cuspid.handpiece.cad.shell import PrintOptions, module_boxes
from cuspid.handpiece.designs import DESIGNS, DesignOptions, six_cameras
from cuspid.handpiece.intra_oral import intra_oral_camera
from cuspid.model.body import Body
from cuspid.model.rig import Handpiece, MountedCamera, Rig
from cuspid.runtime.errors import InputError
from verbs import refused, run

BUILT_IN = {name: make() for name, make in DESIGNS.items()} | {"wand": intra_oral_camera()}


@pytest.fixture(scope="module", params=BUILT_IN)
def made(request) -> Printable:
    return printable(BUILT_IN[request.param])


@pytest.fixture(scope="module")
def four() -> Printable:
    return printable(BUILT_IN["four"])


def modules(of: Printable) -> dict[str, Manifold]:
    return {name: block(box) for name, box in module_boxes(of.handpiece).items()}


def moved(handpiece: Handpiece, new_from_rig: Rigid3) -> Handpiece:
    """The same handpiece in another frame."""
    rig_from_new = new_from_rig.inverse()
    cameras = {
        name: MountedCamera(each.camera, each.cam_from_rig @ rig_from_new)
        for name, each in handpiece.rig.cameras.items()
    }
    lights = {
        name: replace(
            light, position_mm=new_from_rig.apply(light.position_mm), direction=new_from_rig.rotate(light.direction)
        )
        for name, light in handpiece.lights.items()
    }
    boxes = handpiece.solid.parts.items()
    body = Body({name: replace(box, box_from_rig=box.box_from_rig @ rig_from_new) for name, box in boxes})
    return replace(handpiece, rig=Rig(cameras), lights=lights, body=body)


def test_a_holder_is_one_closed_piece_with_walls_as_asked_for(made):
    found = check_printable(made, PrintOptions())
    stored = trimesh.Trimesh(made.mesh.vertices.astype(np.float32), made.mesh.faces)
    assert stored.is_watertight
    assert len(stored.split(only_watertight=False)) == 1
    assert stored.volume == pytest.approx(found.volume_mm3, rel=1e-4)
    assert 0.78 < found.wall.thickness_mm < 0.81
    assert found.web is not None
    assert found.web.thickness_mm > 0.098


def test_every_seat_opens_to_the_front_and_every_cable_comes_out(made):
    """Each opening but the first adds a handle to the surface: the seats, and the end of the grip."""
    assert made.solid.genus() == len(made.seats)


def test_modules_go_into_their_seats_and_out(made):
    for name, module in modules(made).items():
        assert (module ^ made.solid).volume() < 1e-9
        seat = made.seats[f"seat of {name}"]
        assert (module - seat).volume() < 1e-9
        axis = module_boxes(made.handpiece)[name].box_from_rig.rotation[2]
        for way_mm in (0.3, 1.0, 2.0):
            assert (module.translate(axis * way_mm) ^ made.solid).volume() < 1e-9


def test_a_module_rests_on_its_shoulder(made):
    for name, module in modules(made).items():
        axis = module_boxes(made.handpiece)[name].box_from_rig.rotation[2]
        assert (module.translate(axis * -0.05) ^ made.solid).volume() > 1e-3


def test_the_body_of_the_handpiece_holds_all_but_the_grip(made):
    boxes = Manifold.batch_boolean([block(box) for box in made.handpiece.solid.parts.values()], OpType.Add)
    assert (made.solid - boxes - made.shells["grip"]).volume() < 1e-6
    for name, box in made.handpiece.solid.parts.items():
        if name.startswith(("camera ", "light ")):
            assert box is module_boxes(made.handpiece)[name]


def test_larger_clearances_make_larger_pockets(four):
    tight, loose = (printable(four.handpiece, PrintOptions(seat_clearance_mm=each)) for each in (0.0, 0.1))
    for name in four.seats:
        assert tight.seats[name].volume() < four.seats[name].volume() < loose.seats[name].volume()
    cut = [
        each.shells["head 1"].volume() - (each.shells["head 1"] ^ each.solid).volume() for each in (tight, four, loose)
    ]
    assert cut[0] < cut[1] < cut[2]


@pytest.mark.parametrize("name", ["four", "twelve"])
def test_a_holder_does_not_depend_on_the_frame(name):
    there = moved(BUILT_IN[name], Rigid3.from_rotation_vector(np.array([0.3, -1.1, 0.7]), np.array([20.0, -7, 3])))
    here, turned = printable(BUILT_IN[name]), printable(there)
    assert turned.solid.volume() == pytest.approx(here.solid.volume(), rel=1e-4)
    assert turned.solid.genus() == here.solid.genus()
    check_solid(turned)
    assert thinnest(turned, PrintOptions())[0].thickness_mm == pytest.approx(0.8, abs=0.01)


@pytest.mark.parametrize("name", DESIGNS)
@pytest.mark.parametrize("lights", ["colour-coded", "in-turn"])
def test_coloured_lights_have_a_holder_that_no_light_shines_into(name, lights):
    check_printable(printable(DESIGNS[name](DesignOptions(lights=lights))), PrintOptions())


def test_a_ring_of_lights_that_another_head_blocks_is_told():
    with pytest.raises(InputError, match="blocks light"):
        check_printable(printable(DESIGNS["twelve"](DesignOptions(lights="colour-coded", ring_mm=5.0))), PrintOptions())


def test_cameras_that_lean_within_a_head_see_past_it():
    check_printable(printable(six_cameras(DesignOptions(outer_tilt_deg=15.0))), PrintOptions())


def test_a_camera_far_before_its_neighbours_gets_a_collar():
    pair = BUILT_IN["two"]
    wide = replace(
        pair, rig=Rig({**pair.rig.cameras, "o2": shifted(pair.rig["o2"], np.array([0.0, -3.0, -1.8]))}), body=None
    )
    made = printable(wide)
    assert "collar of camera o2" in made.shells
    check_printable(made, PrintOptions())


def shifted(mounted: MountedCamera, by_mm: np.ndarray) -> MountedCamera:
    return replace(mounted, cam_from_rig=mounted.cam_from_rig @ Rigid3(np.eye(3), -by_mm))


def test_a_wall_before_a_lens_is_told(four):
    axis, centre = four.handpiece.rig["o2"].axis_in_rig, four.handpiece.rig["o2"].centre_in_rig
    wall = Manifold.cube((2.0, 2.0, 0.2), True).translate(centre + 1.5 * axis)
    check_sight(four.solid, four.handpiece, PrintOptions())
    with pytest.raises(InputError, match=r"blocks camera o., 1\.4 mm in front of it"):
        check_sight(four.solid + wall, four.handpiece, PrintOptions())


def test_what_is_only_in_the_way_of_light_is_told_for_wide_lobes():
    twelve = BUILT_IN["twelve"]
    narrow, wide = PrintOptions(light_half_angle_deg=35.0), PrintOptions(light_half_angle_deg=80.0)
    solid = printable(twelve).solid
    check_sight(solid, twelve, narrow)
    with pytest.raises(InputError, match="blocks light"):
        check_sight(solid, twelve, wide)


@pytest.mark.parametrize("left_mm", [0.3, 0.6, 0.75])
def test_a_thin_wall_is_told_with_its_thickness(four, left_mm):
    """The bore of the neck goes on up to the outside, but for a film."""
    outer = four.handpiece.solid.parts["neck"]
    high = outer.corners.max(axis=0)
    pit = Manifold.cube((4.0, 2.0, 2.0), True).translate([-30.0, 0.0, high[2] - left_mm - 1.0]).as_original()
    thin = replace_hollow(four, pit)
    with pytest.raises(InputError, match=rf"{left_mm:.2f} mm between .*less than --wall-mm 0\.8"):
        thinnest(thin, PrintOptions())


def replace_hollow(of: Printable, pit: Manifold) -> Printable:
    """A holder with one more duct."""
    solid = of.solid - pit
    raw = solid.to_mesh64()
    vertices, faces = np.asarray(raw.vert_properties)[:, :3], np.asarray(raw.tri_verts).astype(np.int64)
    ids = {each.original_id(): index for index, each in enumerate([*of.shells.values(), *of.hollows.values(), pit])}
    lengths = np.diff(np.asarray(raw.run_index, dtype=np.int64)) // 3
    source = np.repeat([ids[each] for each in raw.run_original_id], lengths)
    mesh = replace(of.mesh, vertices=vertices, faces=faces)
    return replace(of, solid=solid, mesh=mesh, source=source, names=(*of.names, "pit"), ducts={**of.ducts, "pit": pit})


def test_a_holder_in_pieces_is_told(four):
    with pytest.raises(InputError, match="falls into 2 pieces"):
        check_solid(replace(four, solid=four.solid + Manifold.cube((1.0, 1.0, 1.0)).translate([0.0, 0.0, -20.0])))


def test_a_duct_through_a_seat_is_told(four):
    through = block(four.handpiece.solid.parts["camera o3"]).translate([0.4, 0.0, 0.0])
    with pytest.raises(InputError, match="stray runs through the seat of camera o3"):
        check_seats(replace(four, ducts={**four.ducts, "stray": through}), PrintOptions())


def test_a_seat_without_a_way_out_is_told(four):
    alone = make_rounded_box(four.handpiece.solid.parts["camera o1"], 0.1).translate([0.0, 0.0, 30.0])
    with pytest.raises(InputError, match="a cable cannot pass"):
        check_solid(replace(four, channels={**four.channels, "lost": alone}))


@pytest.mark.parametrize(
    ("design", "printing", "said"),
    [
        ({"baseline_along_mm": 0.8}, {}, "modules of camera o3 and camera o4 overlap"),
        ({"baseline_along_mm": 1.15}, {}, r"seats of camera o3 and camera o4 is 0\.05 mm thick.*--web-mm 0\.1"),
        ({}, {"web_mm": 0.2}, r"is 0\.15 mm thick, less than --web-mm 0\.2"),
        ({}, {"mouth_opening_mm": 11.0}, r"6\.9 mm thick and 5 mm over the teeth"),
        ({}, {"shoulder_mm": 0.25}, "no room for its cable"),
        ({"holder": HolderOptions(camera_mm=(2.0, 2.0, 1.6))}, {}, "overlap"),
    ],
)
def test_what_cannot_be_built_is_refused_in_one_line(design, printing, said):
    options = PrintOptions(**printing)
    with pytest.raises(InputError, match=said):
        check_printable(printable(DESIGNS["four"](DesignOptions(**design)), options), options)


def test_walls_that_leave_no_bore_are_refused():
    with pytest.raises(InputError, match="wider than two walls"):
        PrintOptions(neck_width_mm=3.0)
    with pytest.raises(InputError, match="--handle-wall-mm"):
        PrintOptions(wall_mm=1.6)


def test_a_body_without_modules_is_refused():
    bare = BUILT_IN["two"]
    parts = {name: box for name, box in bare.solid.parts.items() if name != "camera o2"}
    with pytest.raises(InputError, match="no box named 'camera o2'"):
        printable(replace(bare, body=Body(parts)))


def test_a_handpiece_of_a_file_gets_its_holder_and_its_body(tmp_path, capsys):
    run("rig", "build", "--design", "two", "--out", tmp_path / "drawn")
    drawn = tmp_path / "drawn" / "handpiece.json"
    out, body = tmp_path / "probe", tmp_path / "probe" / "holder.stl"
    run("rig", "build", "--handpiece", drawn, "--out", out, "--body", body, "--mouth-opening-mm", 12)
    said = capsys.readouterr().err
    assert "thinnest wall 0.80 mm" in " ".join(said.split())
    written = trimesh.load_mesh(body)
    assert written.is_watertight
    assert written.volume == pytest.approx(printable(storage.read_handpiece(drawn)).solid.volume(), rel=1e-4)
    assert (out / "holder.png").stat().st_size > 10_000
    assert "neck" in storage.read_handpiece(out / "handpiece.json").solid.parts


def test_the_command_says_what_is_wrong_and_writes_nothing(tmp_path, capsys):
    command = ("rig", "build", "--design", "four", "--out", tmp_path / "probe")
    body = tmp_path / "holder.stl"
    assert "less than --web-mm" in refused(capsys, *command, "--body", body, "--web-mm", 0.3)
    assert "--body must end in" in refused(capsys, *command, "--body", tmp_path / "holder.step")
    assert "add --body" in refused(capsys, *command, "--web-mm", 0.3)
    assert not list(tmp_path.iterdir())
