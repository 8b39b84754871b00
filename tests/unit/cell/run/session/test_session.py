"""How a cell may be opened: what does not go together is refused before anything is started."""

from pathlib import Path
from typing import Any

import pytest

from cell import Cell, ConfigError
from cell.config.cell_config import default_toml
from cell.run.session.session import kept_speed


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"sim": "all", "clock": "sundial"}, 'clock="sundial" is not offered'),
        ({"sim": "all", "clock": "virtual", "speed": 2.0}, "speed means nothing on it"),
        ({"sim": "none", "clock": "virtual"}, 'only a simulated cell, sim="all", has one'),
        ({"sim": "rail", "clock": "virtual"}, 'only a simulated cell, sim="all", has one'),
        ({"sim": "none", "truth": "cell.toml"}, "truth describes a cell that is all simulated"),
    ],
)
@pytest.mark.usefixtures("here")
def test_options_that_do_not_go_together_are_refused(options: dict[str, Any], says: str):
    Path("cell.toml").write_text(default_toml())
    with pytest.raises(ConfigError, match=says):
        Cell.open(**options)


@pytest.mark.usefixtures("here")
def test_the_supervisor_script_is_held_to_the_same():
    with pytest.raises(ConfigError, match="there is no cell"):
        Cell.open()
    Path("cell.toml").write_text(default_toml())
    with pytest.raises(ConfigError, match="still the example's"):
        Cell.open()


def test_a_slower_computer_keeps_a_slower_cell_and_never_one_slower_than_the_wall():
    assert [kept_speed(1e-3 * took) for took in (2.0, 4.4, 6.6, 8.9, 60.0)] == [3.0, 3.0, 2.0, 1.5, 1.0]
