"""The paper, reproduced: its design study and its table, each with what was wrong.

Behind `cell paper`: never imported by the product's own path. What is simulated here says so beside every figure.
"""
