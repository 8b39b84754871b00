"""Promises on what people are told of a calibration from recorded frames."""

from __future__ import annotations

from cell.apps.cli.calibration.recorded_tables import verdicts


def test_refused_values_are_shown_and_marked():
    check = {"part": "hand_eye", "verdict": "refused", "text": "hand-eye: too far off"}
    value = {"setup": "eye_in_hand", "translation_mm": [1, 2, 3], "sigma_mm": [4, 5, 6], "sigma_deg": [0.1, 0.2, 0.3]}
    none = dict.fromkeys(("intrinsics", "hand_eye", "light_plane"))
    result = {**none, "checks": [check], "notes": ["no light plane: dark"], "refused_values": {"hand_eye": value}}
    camera, hand, plane = verdicts({**result, "refused": {"hand_eye": check["text"]}})
    assert hand.startswith("hand-eye: REFUSED (do not use: eye in hand, x 1.00 ± 4.00, y 2.00 ± 5.00")
    assert hand.endswith("too far off")
    assert plane == "light plane: none: no light plane: dark"
    assert camera == "camera: none: not asked for"
