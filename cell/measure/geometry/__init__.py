"""Camera model, light plane, poses and their uncertainty: closed mathematics, no image and no device."""
