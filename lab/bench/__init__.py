"""Campaigns and comparisons behind `cell bench`: never imported by the product's own path."""
