"""The arm's controller on the network."""
