"""What a scan shows of effects that the registration does not model: creep, droop, rocking, a moved surface."""
