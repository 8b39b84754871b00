"""The laser in pictures: its sheet, the stripe, its profile, speckle and shadows."""
