"""The skid-steered carrier, on AgileX protocol v2 over CAN."""
