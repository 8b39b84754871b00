"""The rail on its wire."""
