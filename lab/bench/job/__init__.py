"""The whole job: accuracy beside its bound, effects of the workshop."""
