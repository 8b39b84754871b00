"""Where checks work: nothing moves there without a person's word."""

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
