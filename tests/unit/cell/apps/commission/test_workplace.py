"""Where checks work: nothing moves there without a person's word."""

from cell.apps.commission.workplace import CommissionWorkplace, Person
from tests.support.commissioning import commissioned, files


def test_nothing_moves_without_a_persons_word_and_what_needs_it_waits(tmp_path):
    files(tmp_path, lambda text: text)
    asked: list[str] = []

    def ask(text: str) -> bool:
        asked.append(text)
        return "moves for the first time" not in text

    good, shown = commissioned(tmp_path, "payload", ask)
    assert not good
    assert [row[:2] for row in shown.rows] == [
        ("links", "good"), ("arm_axes", "declined"), ("payload", "waits for arm_axes"),
    ]  # fmt: skip
    assert sum("joint 1 moves for the first time: this joint alone, 2 deg" in text for text in asked) == 1


def test_a_word_for_little_is_none_for_more(tmp_path):
    asked: list[str] = []
    person = Person(lambda text: asked.append(text) or True)
    work = CommissionWorkplace(tmp_path, lambda: None, person, tmp_path, "pot", simulated=True)
    for fast in ("15 deg/s", "60 deg/s", "15 deg/s"):
        work.confirm("the arm as a whole", "planned ways", "its whole reach", fast)
    assert [text.split(", ")[2].split(".")[0] for text in asked] == ["15 deg/s", "60 deg/s"]
