"""The laboratory: campaigns, comparisons and the paper's figures. Nothing of the product imports it."""
