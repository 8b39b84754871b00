"""Acceptance tests of the trade on a simulated head."""
