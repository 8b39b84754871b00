"""The stripe's centres beside their bound."""
