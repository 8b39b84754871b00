"""Board detection."""
