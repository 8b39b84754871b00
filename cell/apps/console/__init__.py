"""The operator's screen: a page that shows the cell, holds it and stops it (docs/reference/console.md).

The program that has opened the cell is one process, the server that browsers talk to another one beside it: whatever
they send, and however many they are, the cell's own threads do not share an interpreter with that.
"""
