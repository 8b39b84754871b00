"""Pictures that cannot be read are refused with their reason."""

import cv2
import numpy as np
import pytest

from cell.measure.vision.pictures import PictureRefused, Reason, read_picture


def test_cut_and_foreign_files_are_refused(tmp_path):
    whole = tmp_path / "whole.png"
    cv2.imwrite(str(whole), np.full((1024, 1280), 90, np.uint8))
    assert read_picture(whole).shape == (1024, 1280)
    cut = tmp_path / "cut.png"
    cut.write_bytes(whole.read_bytes()[:-2000])
    text = tmp_path / "text.jpg"
    text.write_text("no picture")
    for path, reason in ((cut, Reason.CUT), (text, Reason.UNREADABLE), (tmp_path / "none.png", Reason.UNREADABLE)):
        with pytest.raises(PictureRefused) as refused:
            read_picture(path)
        assert refused.value.reason is reason
