"""Which devices may be simulated beside real ones: what physics does not allow is refused before anything is opened."""

import pytest

from cell import Cell
from cell.config.cell_config import DEVICES, default_toml, load_config
from cell.devices.simulated.described import Described
from cell.devices.simulated.mixed import beware, followed, named, require_possible
from cell.run.report.figures import following_words
from drivers.errors import ConfigError

CONFIG = load_config(None)
CAMERAS = ("scan_camera", "target_camera")
POSSIBLE = (
    "scan_camera", "claw", "scan_camera,laser", "scan_camera,claw", "scan_camera,rail", "scan_camera,rail,laser",
    "scan_camera,target_camera", "scan_camera,target_camera,laser", "scan_camera,target_camera,vehicle",
    "scan_camera,target_camera,laser,claw,arm", "scan_camera,target_camera,laser,claw,arm,rail",
    "scan_camera,target_camera,laser,claw,arm,vehicle", "scan_camera,target_camera,laser,claw,rail,vehicle",
)  # fmt: skip
IMPOSSIBLE = {
    "laser": "scan_camera is real: its pictures show nothing of what laser only simulated would do",
    "rail": "scan_camera is real",
    "target_camera": "scan_camera is real",
    "vehicle": "show nothing of what vehicle only simulated would do\n  target_camera is real",
    "arm": "laser is real and hangs on the arm's output, and the arm is simulated",
    "scan_camera,vehicle": "target_camera is real",
    "scan_camera,laser,claw,arm": "target_camera is real",
    "scan_camera,target_camera,claw,arm": "laser is real and hangs on the arm's output",
}


def simulated(text: str) -> tuple[str, ...]:
    names = named(text)
    assert names is not None
    return names


@pytest.mark.parametrize("text", POSSIBLE)
def test_what_no_real_camera_would_see_may_be_simulated(text: str):
    require_possible(CONFIG, simulated(text), tuple(DEVICES))


@pytest.mark.parametrize("text", IMPOSSIBLE)
def test_what_a_real_device_would_need_cannot_be_simulated(text: str):
    with pytest.raises(ConfigError, match="cannot be simulated beside the others") as refused:
        require_possible(CONFIG, simulated(text), tuple(DEVICES))
    assert IMPOSSIBLE[text] in str(refused.value)


def test_the_world_follows_what_is_real_and_what_hangs_on_the_arm_comes_with_the_arm():
    assert followed(CONFIG, simulated("scan_camera,laser"), tuple(DEVICES)) == ("arm", "rail", "vehicle")
    assert followed(CONFIG, simulated("all"), tuple(DEVICES)) == ()
    assert followed(CONFIG, ("scan_camera",), ("scan_camera", "rail")) == ("rail",)


def test_what_is_asked_for_may_be_a_list_a_text_or_the_configurations():
    assert named(["laser", "scan_camera"]) == named(" laser, scan_camera") == ("scan_camera", "laser")
    assert (named("none"), named(None), named(list(DEVICES))) == ((), None, tuple(DEVICES))


def test_a_person_is_told_what_is_simulated_and_what_that_means():
    first, *others = beware(("scan_camera", "claw"), tuple(DEVICES))
    assert first == "simulated: scan_camera, claw; real: arm, rail, vehicle, target_camera, laser"
    assert any("the real arm moves by simulated pictures" in text for text in others)
    assert any("brake is simulated" in text for text in beware((*CAMERAS, "vehicle"), tuple(DEVICES)))
    assert any("posture is simulated" in text for text in beware((*CAMERAS, "arm"), tuple(DEVICES)))


def _written(tmp_path, sim: str = "[]"):
    path = tmp_path / "cell.toml"
    path.write_text(default_toml().replace("sim = []", f"sim = {sim}"), encoding="utf-8")
    return path


def test_the_configuration_names_them_and_a_real_device_at_an_example_address_is_refused(tmp_path):
    config = _written(tmp_path, sim='["scan_camera", "laser"]')
    with pytest.raises(ConfigError, match=r"target_camera\.address.*still the example's") as refused:
        Cell.open(config)
    assert "scan_camera" not in str(refused.value)


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"sim": "scan_camera,lasser"}, "there is no device 'lasser'"),
        ({"sim": ["scan_camera"], "clock": "virtual"}, 'only a simulated cell, sim="all", has one'),
        ({"sim": "scan_camera", "confirm": "simulated"}, "at a real one a person looks and confirms"),
    ],
)
def test_a_wrong_wish_is_refused(tmp_path, keywords, words):
    with pytest.raises(ConfigError) as refused:
        Cell.open(_written(tmp_path), **keywords)
    assert words in str(refused.value)


def test_an_unknown_device_in_the_configuration_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="there is no device camera"):
        load_config(_written(tmp_path, sim='["camera"]'))


def test_real_devices_of_any_make_can_be_drawn_beside_simulated_ones():
    camera = CONFIG.target_camera.model_copy(update={"driver": "v4l2"})
    bought, pot = CONFIG.model_copy(update={"target_camera": camera}), Described.of("pot")
    with pytest.raises(ConfigError, match="nothing simulates this make"):
        pot.drawing(bought)
    assert pot.drawing(bought, ("scan_camera", "laser")).cell.arm == "UR10e"


def test_how_late_real_devices_were_followed_is_shown_in_a_line():
    late = {"readings": 9, "latency_ms": {"p50": 7.4, "p99": 31.0, "most": 40.0}, "apart_ms": None}
    told = {"devices": {"arm": late, "rail": {**late, "latency_ms": None}}, "not_made": 1}
    assert following_words(told) == "arm 7 ms (99 %: 31); 1 picture not made"
    assert following_words({"missing": "no answer"}) == "not told: no answer"
