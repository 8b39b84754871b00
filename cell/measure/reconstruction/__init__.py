"""From stripe profiles to an organised cloud in the arm base."""
