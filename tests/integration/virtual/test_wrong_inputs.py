"""Whatever is wrong in a configuration, a job or a command line is told in the cell's own words, before anything moves.

Every case goes through the real command line: exit code 2, no traceback, no word of the libraries underneath.
"""

import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
import typer.main

from cell.config.cell_config import default_toml
from cell.config.job import job_path
from tests.support import Typed, described_cells

JARGON = (
    "Traceback", "pydantic", "Input should be", "type=", "input_value", "valid string", "valid dictionary",
    "Field required", "Value error", "dimensionality", "Cannot convert", "not defined in the unit", "pint",
    "TOMLDecodeError", "Expected", "Invalid statement", "Errno", "codec", "NoneType", "ValidationError", "trimesh",
    "unexpected keyword", "object has no attribute",
)  # fmt: skip


def changed(text: str, key: str, value: str | None) -> str:
    """A TOML text with the value of "table.key" replaced, added, or with None removed."""
    table, _, name = key.rpartition(".")
    if value is None:
        return re.sub(rf"(?m)^{name} = .*\n", "", text)
    return described_cells.changed(text, {table: {name: value}})


def pose(*numbers: float) -> str:
    """A pose in TOML, mm and deg."""
    x, y, z, a, b, c = (*numbers, 0.0, 0.0, 0.0)[:6]
    return described_cells.pose((x, y, z), (a, b, c))


def write_mesh(path: Path, size: tuple[float, float] = (0.07, 0.036), height: float = 0.008, at: float = 0.0) -> None:
    """A small mesh: a slightly bent sheet around (at, 0), m."""
    x, y = (
        axis.ravel() for axis in np.meshgrid(*(np.linspace(-side / 2, side / 2, 8) for side in size), indexing="ij")
    )
    vertices = np.column_stack([x + at, y, height * (1 - (x / size[0]) ** 2)])
    a = np.arange(64).reshape(8, 8)[:-1, :-1].ravel()
    faces = np.concatenate([np.column_stack([a, a + 8, a + 9]), np.column_stack([a, a + 9, a + 1])])
    trimesh.Trimesh(vertices, faces, process=False).export(path)


@pytest.fixture(scope="module", autouse=True)
def commands_put_together_once() -> Iterator[None]:
    """A process runs one command; typer puts all of them together anew for each, which takes longer than a check."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("typer.main.get_command", cache(typer.main.get_command))
        yield


@pytest.fixture(autouse=True)
def place(here: Path) -> Path:
    """An empty folder to work in, with a small mesh beside it all."""
    write_mesh(here / "pot.ply")
    return here


def assert_refused(ended: tuple[int, str, str], words: tuple[str, ...]) -> None:
    code, shown = ended[0], ended[1] + ended[2]
    for word in words:
        assert word in shown, shown
    for word in JARGON:
        assert word not in shown, shown
    assert code == 2, shown


WRONG_CONFIGURATIONS: list[tuple[str, str | None, tuple[str, ...]]] = [
    # addresses and ports
    ("arm.address", '"300.1.2.3"', ("arm.address", "0 to 255")),
    ("arm.address", "5", ("arm.address", "is no text; write it in quotes")),
    ("scan_camera.address", '"10.0.0.20:0"', ("scan_camera.address", "1 to 65535")),
    ("target_camera.address", '"192.0.2.20:5000"', ("scan_camera.address and target_camera.address are both",)),
    ("cell.truth", '"nowhere"', ("cell.truth", "HOST:PORT")),
    ("cell.truth", '"192.0.2.20:5000"', ("scan_camera.address and cell.truth are both",)),
    # the rail's line
    ("rail.url", '""', ("rail.url", "no serial port", "/dev/ttyUSB0")),
    ("rail.url", '"/dev/ttyUSB0"', ("rail.url and vehicle.channel are both",)),
    # CAN
    ("vehicle.interface", '"canfoo"', ("vehicle:", '"canfoo" is unknown', "socketcan")),
    ("vehicle.bitrate", '"500 kHz"', ("vehicle.bitrate", "not a quantity in kbit/s")),
    # inputs and outputs of the arm
    ("laser.output", "18", ("laser.output", "0 to 17", "16-17 tool")),
    ("laser.output", "true", ("laser.output", "no whole number")),
    ("claw.output", "0", ("laser.output and claw.output are both", "arm output 0")),
    ("claw.feedback", "18", ("claw.feedback", "0 to 17")),
    # numbers and units
    ("rail.lead", "2", ("rail.lead", "has no unit", '"0.1 mm"')),
    ("rail.lead", '"-2 mm"', ("rail.lead", "0.1 to 50 mm")),
    ("rail.microsteps", "3", ("rail.microsteps", "1, 2, 4, 8")),
    ("rail.steps_per_turn", "200.5", ("rail.steps_per_turn", "no whole number")),
    ("rail.travel", '["0 mm", "0 mm"]', ("rail:", "the first must be smaller")),
    ("rail.travel", '["0 mm"]', ("rail.travel[1]", "missing")),
    ("rail.travel", '["0 mm", "50 mm", "100 mm"]', ("rail.travel", "at most 2")),
    ("rail.travel", '"100 mm"', ("rail.travel", "is no list")),
    ("rail.travel", '["0 mm", "100 m"]', ("rail.travel[1]", "-100 to 2000 mm")),
    ("rail.max_speed", '"5 kHz"', ("rail.max_speed", "not a quantity in mm/s")),
    ("rail.acceleration", '"200 mm/s"', ("rail.acceleration", "not a quantity in mm/s^2")),
    ("arm.max_tool_speed", '"5 m/s"', ("arm.max_tool_speed", "1 to 1500 mm/s")),
    ("arm.payload", '"20 kg"', ("arm.payload", "0 to 12.5 kg")),
    ("arm.payload_centre", '["0 mm", "0 mm", "2 m"]', ("arm.payload_centre[2]", "-500 to 500 mm")),
    ("arm.model", '"UR4"', ("arm.model", '"UR4" is not one of "UR3", "UR5"')),
    ("arm.model", '"UR5"', ("job pot does not fit this cell", "calibration view 1")),
    ("arm.vehicle_from_base", pose(300, 0, 5500), ("arm:", "off the vehicle")),
    ("arm.vehicle_from_base", pose(300, 0, 550, 90), ("arm:", "upright")),
    ("arm.vehicle_from_base", '"here"', ("arm.vehicle_from_base", "is no table")),
    ("vehicle.max_yaw_rate", '"5 deg/s"', ("vehicle.max_yaw_rate", "25 to 90 deg/s")),
    ("laser.tan_theta", "nan", ("laser.tan_theta", "0.2 to 20")),
    ("laser.tan_theta", '"3.5"', ("laser.tan_theta", "no plain number")),
    ("laser.baseline", '"350 mm"', ("the laser's line is not in the scan camera's picture",)),
    ("scan_camera.height", "64", ("scan_camera:", "no shape of a sensor")),
    ("target_camera.focal_length", '"200 mm"', ("board.spec", "pixels of 1280 x 1024")),
    ("scan_camera.flange_from_camera", pose(90, -50, 80000), ("scan_camera.flange_from_camera", "-1000 to 1000 mm")),
    ("target_camera.flange_from_camera", pose(0, 0, 0), ("target_camera.flange_from_camera", "into the claw")),
    # boards and calibration
    ("calibration.fine.board", '"marked_dots:11"', ("calibration.fine.board", "KIND:COLSxROWS:PITCH")),
    ("calibration.fine.board", '"marked_dots:11x9:30mm"', ("calibration.fine.board", "pixels of 640 x 480")),
    ("calibration.fine.board", '"dots:11x9:3mm"', ("calibration.fine.board", "half a turn")),
    ("calibration.fine.board", '"aprilgrid:5x4:3mm"', ("calibration.fine.board", "no stripe", "marked_dots")),
    ("calibration.large.board", '"marked_dots:9x7:1mm"', ("calibration.large.board", "pixels apart")),
    ("calibration.fine.base_from_board", pose(-5650, 262, 20, 180), ("fine.base_from_board", "not on the deck")),
    ("calibration.large.base_from_board", pose(-680, -190, 900, 180), ("calibration.large.base_from_board", "300 mm")),
    ("calibration.fine.base_from_board", pose(-565, 262, 20), ("calibration view 1",)),
    # the cell as a whole
    ("cell.name", '""', ("cell.name", "is no name")),
    ("cell.runs", '"/var/runs"', ("cell.runs", "no absolute path")),
    ("cell.runs", '"calibrations"', ("cell:", "both")),
    ("cell.calibrations", '"~/store"', ("cell.calibrations", "no folder beside this file")),
    ("cell.time_scale", "3.0", ("cell:", "real devices need time_scale = 1")),
    ("cell.confirm", '"simulated"', ("cell.confirm", "only for a simulated cell", "a person looks")),
    ("cell.colour", '"red"', ("cell.colour", "unknown key")),
    ("rail.driver", '"plc"', ("rail.driver", '"plc" is not one of "tmcl"')),
    ("rail.lead", None, ("rail.lead", "missing", "cell init")),
]  # fmt: skip


@pytest.mark.parametrize(("key", "value", "words"), WRONG_CONFIGURATIONS)
def test_a_wrong_configuration_does_not_pass_the_check(
    typed: Typed, place: Path, key: str, value: str | None, words: tuple[str, ...]
):
    (place / "cell.toml").write_text(changed(default_toml(), key, value))
    (place / "pot.toml").write_text(job_path("pot").read_text())
    assert_refused(typed("check"), words)


WRONG_JOBS: list[tuple[str, str | None, tuple[str, ...]]] = [
    ("job.name", '"a/b"', ("job.name", "no slash")),
    ("job.colour", '"red"', ("job.colour", "unknown key")),
    ("board.spec", '"chess:7x6:10mm"', ("board.spec", "unknown kind")),
    ("board.spec", '"dots:9x7:20mm"', ("board.spec", "half a turn")),
    ("board.spec", '"marked_dots:9x7:40mm"', ("board.spec", "larger than the plate")),
    ("board.place_from_board", pose(142, 400, -300, -135, 0, -90), ("board.place_from_board", "above the table")),
    ("board.place_from_board", pose(142, 2400, 162, -135, 0, -90), ("looking pose", "out of reach")),
    ("board.place_from_board", pose(142, 400, 162, 45, 0, -90), ("board", "looking pose")),
    ("approach.staging", pose(-900, 0, -600), ("approach", "staging has to lie between")),
    ("approach.start", pose(-1500, 0, -600), ("approach", "staging has to lie between")),
    ("approach.start", pose(-3050, 2000, -600), ("approach.start", "beside the target's line")),
    ("approach.staging", pose(-1850, 0, -500), ("approach", "one height")),
    ("approach.target", pose(-1050, 0, -600, 0, 20), ("approach.target", "tilted")),
    ("approach.target", pose(-500, 0, -600), ("approach", "of the table")),
    ("approach.target", pose(-1050, 0, 600), ("approach", "one height")),
    ("approach.target", pose(-1700, 0, -600), ("out of reach",)),
    ("approach.speed", '"0.9 m/s"', ("approach.speed 900 mm/s exceeds vehicle.max_speed",)),
    ("photo.stand_off", '"150 mm"', ("board.spec", "pixels of 1280 x 1024")),
    ("photo.stand_off", '"5 m"', ("board.spec", "pixels apart")),
    ("photo.stand_off", '"2500 mm"', ("out of reach",)),
    ("surface.mesh", '""', ("surface.mesh", "name an STL or PLY")),
    ("surface.mesh", '"gone.stl"', ("gone.stl", "is not a file")),
    ("surface.mesh", '"text.stl"', ("text.stl", "give an STL or PLY")),
    ("surface.mesh", '"empty.stl"', ("empty.stl", "give an STL or PLY")),
    ("surface.mesh", '"nan.stl"', ("nan.stl", "not numbers")),
    ("surface.mesh", '"large.stl"', ("large.stl", "check surface.mesh_unit")),
    ("surface.mesh", '"aside.stl"', ("aside.stl", "sees too little of it")),
    ("surface.mesh", '"high.stl"', ("surface.mesh is", "scan.stand_off")),
    ("surface.mesh_unit", '"mm"', ("mesh_unit", "1 to 5000 mm")),
    ("surface.mesh_unit", '"cm"', ("surface.mesh_unit", '"m" or "mm"')),
    ("surface.place_from_surface", pose(0, 0, -100), ("into the table",)),
    ("surface.place_from_surface", pose(900, 0, 0), ("beside the table",)),
    ("surface.place_from_surface", pose(0, 0, 0, 180), ("into the table",)),
    ("scan.length", '"99.5 mm"', ("scan.length 99.5 mm", "rail.travel")),
    ("scan.speed", '"45 mm/s"', ("scan.speed 45 mm/s exceeds rail.max_speed, 40 mm/s",)),
    ("scan.speed", '"0.1 mm/s"', ("scan:", "640 s", "at most 100 s")),
    ("scan.exposure", '"50 ms"', ("scan:", "longer than a frame at 30 Hz", "33.33 ms")),
    ("scan.frame_rate", '"1 Hz"', ("scan:", "4 lines")),
    ("scan.stand_off", '"60 mm"', ("laser's line is not in the scan camera's picture",)),
    ("scan.mode", '"both"', ("scan.mode", '"rail" or "arm"')),
    ("scan.swath", "[]", ("scan.swath", "at least 1")),
    ("scan.swath", '[{ acros = "1 mm" }]', ("scan.swath[0].acros", "unknown key")),
    ("scan.swath", '[{ roll = "80 deg" }]', ("scan.swath[0].roll", "-40 to 40 deg")),
    ("grasp.size", '["-70 mm", "36 mm", "20 mm"]', ("grasp.size[0]", "1 to 1000 mm")),
    ("grasp.size", '["700 mm", "700 mm", "20 mm"]', ("part", "beside the table")),
    ("grasp.size", '["300 mm", "300 mm", "300 mm"]', ("part", "closer than")),
    ("scan.swath", '[{ across = "150 mm" }]', ("sweep 1", "sees too little of it")),
    ("photo.look_down", '"0 deg"', ("looking pose", "not in the target camera's picture", "photo.look_down")),
    ("photo.max_obliquity", '"15 deg"', ("approach.staging", "21 deg from square")),
    ("grasp.flange_from_part", pose(0, 0, 170, 0, 0, 90), ("place.approach",)),
    ("place.speed", '"600 mm/s"', ("place.speed", "0.1 to 500 mm/s")),
    ("place.speed", '"0.5 mm/s"', ("place:", "exceeds speed")),
    ("place.contact_force", '"500 N"', ("place.contact_force", "2 to 120 N")),
    ("place.tolerance_angle", '"6 percent"', ("place.tolerance_angle", "not a quantity in mrad")),
    ("place.surface_from_part", pose(0, 0, -60), ("into the table",)),
    ("place.surface_from_part", pose(0, 0, 900), ("place",)),
]  # fmt: skip


@pytest.mark.parametrize(("key", "value", "words"), WRONG_JOBS)
def test_a_wrong_job_does_not_pass_the_check(
    typed: Typed, place: Path, key: str, value: str | None, words: tuple[str, ...]
):
    (place / "text.stl").write_text("this is no mesh\n" * 40)
    (place / "empty.stl").write_bytes(b"")
    write_mesh(place / "nan.stl", height=float("nan"))
    write_mesh(place / "large.stl", (70.0, 36.0), 8.0)
    write_mesh(place / "aside.stl", at=0.3)
    write_mesh(place / "high.stl", height=0.14)
    (place / "pot.toml").write_text(changed(job_path("pot").read_text(), key, value))
    assert_refused(typed("check", "-j", "pot.toml"), words)


def test_times_that_no_step_has_are_refused(typed: Typed, place: Path):
    slow = changed(job_path("pot").read_text(), "place.speed", '"2 mm/s"')
    (place / "pot.toml").write_text(changed(slow, "place.approach", '"500 mm"'))
    assert_refused(typed("check"), ("place.approach", "502 s", "at most 150 s"))
    slow = changed(job_path("pot").read_text(), "approach.speed", '"0.02 m/s"')
    (place / "pot.toml").write_text(changed(slow, "approach.start", pose(-6050, 0, -600)))
    assert_refused(typed("check"), ("the way of 5.00 m", "250 s", "raise approach.speed"))


def test_all_that_is_wrong_is_told_at_once_and_as_json(typed: Typed, place: Path):
    text = changed(changed(default_toml(), "rail.lead", "2"), "laser.output", "18")
    (place / "cell.toml").write_text(text)
    code, shown, _ = typed("check", "--json")
    told = json.loads(shown)
    assert code == 2
    assert not told["ok"]
    assert [problem.split(":")[0] for problem in told["problems"][1:]] == ["rail.lead", "laser.output"]


RIGHT_CONFIGURATIONS = [
    ("rail.url", '"socket://10.0.0.5:4001"'), ("rail.microsteps", "64"), ("rail.travel", '["-5 mm", "120 mm"]'),
    ("rail.lead", '"0.1 inch"'), ("vehicle.channel", '"socket://10.0.0.6:3000"'), ("arm.max_tool_speed", '"0.25 m/s"'),
    ("arm.max_joint_speed", '"1 rad/s"'), ("arm.settle_time", '"500 ms"'),
    ("arm.vehicle_from_base", pose(300, 20, 550, 0, 0, 3)), ("laser.output", "17"), ("laser.tan_theta", "3"),
    ("scan_camera.photo_exposure", '"5 ms"'), ("calibration.max_age", '"2 week"'), ("cell.confirm", '"person"'),
]  # fmt: skip


RIGHT_JOBS = [
    ("job.name", '"pot no. 7_b"'), ("scan.mode", '"arm"'),
    ("scan.swath", '[{ across = "-9 mm" }, { across = "9 mm", roll = "6 deg" }]'), ("scan.length", '"80 mm"'),
    ("approach.target", pose(-1000, 0, -600)), ("approach.start", pose(-3050, 100, -600, 0, 0, 5)),
    ("place.approach", '"80 mm"'), ("place.tolerance", '"200 um"'), ("photo.stand_off", '"850 mm"'),
    ("grasp.size", '["60 mm", "40 mm", "25 mm"]'), ("surface.place_from_surface", pose(10, -10, 2)),
    ("board.spec", '"charuco:8x6:20mm"'),
]  # fmt: skip


@pytest.mark.parametrize(
    ("file", "key", "value"),
    [("cell.toml", *each) for each in RIGHT_CONFIGURATIONS] + [("pot.toml", *each) for each in RIGHT_JOBS],
)
def test_right_values_pass(typed: Typed, place: Path, file: str, key: str, value: str):
    for name, text in (("cell.toml", default_toml()), ("pot.toml", job_path("pot").read_text())):
        (place / name).write_text(changed(text, key, value) if name == file else text)
    code, out, error = typed("check")
    assert code == 0, out + error


def test_a_mesh_in_millimetres_passes_with_its_unit(typed: Typed, place: Path):
    write_mesh(place / "pot.ply", (70.0, 36.0), 8.0)
    (place / "pot.toml").write_text(changed(job_path("pot").read_text(), "surface.mesh_unit", '"mm"'))
    assert typed("check")[0] == 0


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"[cell\n", ("wrong.toml", "not valid TOML")),
        (b"", ("missing",)),
        (b'colour = "red"\n', ("colour", "unknown key")),
        (b"cell = 3\n", ("cell",)),
    ],
)
@pytest.mark.parametrize("option", ["-c", "-j"])
def test_a_file_that_is_none_is_refused(typed: Typed, place: Path, option: str, content: bytes, words: tuple[str, ...]):
    (place / "wrong.toml").write_bytes(content)
    assert_refused(typed("check", option, "wrong.toml"), words)


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        (("check", "-c", "gone.toml"), ("gone.toml does not exist", "cell init")),
        (("check", "-j", "teapot"), ("teapot", "pot", "cell new-job")),
        (("check", "-j", "."), ("neither a file",)),
        (("check", "-j", "../../pot"), ("neither a file",)),
        (("check", "-j", "gone.toml"), ("gone.toml does not exist", "cell new-job")),
        (("init", "pot.ply"), ("pot.ply", "is no folder")),
        (("init", "-j", "teapot"), ("teapot",)),
        (("run",), ("there is no cell.toml", "-c FILE", "cell init", "`cell run --sim all`")),
        (("commission",), ("there is no cell.toml", "cell commission --sim all")),
        (("jog", "rail", "+5mm"), ("there is no cell.toml", "`cell jog rail +5mm --sim all`")),
        (("jog", "rail", "5"), ("has no unit", "rail +5mm")),
        (("jog", "arm", "q", "5mm"), ("cannot jog", "write it like")),
        (("jog", "vehicle", "+9m"), ("outside the allowed range", "-0.5 to 0.5 m")),
        (("home", "--sim", "some"), ('"all"',)),
        (("dry-run", "--seed", "-1"), ("--seed",)),
        (("dry-run", "--seed", "one"), ("--seed", "whole number", "cell dry-run --help")),
        (("dry-run", "--speed", "0"), ("--speed",)),
        (("dry-run", "--level", "hard"), ("--level",)),
        (("dry-run", "--confirm", "nobody"), ("--confirm",)),
        (("dry-run", "--inject", "arm.protective_stop"), ("no scheduled fault",)),
        (("dry-run", "--inject", "arm.falls@place"), ("arm.falls", "known:")),
        (("dry-run", "-c", "gone.toml"), ("gone.toml does not exist",)),
        (("report",), ("no run at all",)),
        (("report", "nothing"), ("no run nothing",)),
        (("report", "../../etc"), ("no run ../../etc",)),
        (("resume", "nothing"), ("no run nothing",)),
        (("abort", "nothing"), ("no run nothing",)),
        (("export", "nothing"), ("no run nothing",)),
        (("export", "--limit", "0.2"), ("--limit", "has no unit")),
        (("export", "--limit", "9 m"), ("--limit", "0.001 to 100 mm")),
        (("export", "--format", "doc"), ("--format",)),
        (("runs", "-c", "gone.toml"), ("gone.toml does not exist",)),
        (("calibrate", "--from", "gone", "--board", "chessboard:7x6:10mm"), ("gone", "not a folder")),
        (("calibrate", "--from", ".", "--board", "chessboard:7x6:10mm"), ("holds no pictures",)),
        (("calibrate", "--from", "."), ("--board",)),
        (("calibrate", "--board", "chessboard:7x6:10mm"), ("--board belongs to --from",)),
        (("calibrate", "--from", ".", "--board", "chess:7x6"), ("chess:7x6",)),
        (("calibrate", "solve", "gone.npz"), ("gone.npz",)),
        (("sim", "serve", "--job", "teapot"), ("teapot", "pot")),
        (("sim", "fill"), ("there is no cell.toml",)),
        (("sim", "serve", "--config-out", "pot.ply"), ("exists already",)),
        (("sim", "serve", "--config-out", "no/such/sim.toml"), ("no/such",)),
        (("fly",), ("No such command",)),
        (("check", "--colour"), ("No such option",)),
    ],
)
def test_a_wrong_command_line_is_refused(typed: Typed, words: tuple[str, ...], shown: tuple[str, ...]):
    assert_refused(typed(*words), shown)
