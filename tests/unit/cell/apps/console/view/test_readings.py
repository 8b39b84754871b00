"""What a page is told of the cell: what can be held, and jobs by their names."""

from cell.apps.console.view.readings import cell_facts
from cell.run.session.supervisor import Cell


def test_holding_is_offered_only_where_something_beside_the_program_would_stop_it(cell: Cell):
    """The devices on the virtual clock have nothing beside them."""
    facts = cell_facts(cell, "pot")
    assert {entry["device"] for entry in facts["jog"]} == {"rail", "arm", "vehicle"}
    assert not any(entry["hold"] for entry in facts["jog"])
    assert facts["simulated"] is True
    assert facts["jobs"][0] == "pot"
