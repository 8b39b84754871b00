"""The sequence as a Mermaid state diagram, generated from the machine itself.

Transitions that leave every state, or every step, are drawn once.
"""

from __future__ import annotations

from collections import defaultdict

from statemachine.sequence import Sequence, State, Trigger


def mermaid(sequence: Sequence) -> str:
    """The diagram as `stateDiagram-v2` text, without a fence, ending in a newline."""
    ends = (sequence.success, State.REFUSED, State.FAULTED, State.ABORTED)
    inner: list[str] = []
    outer: list[str] = []
    for row in _drawn(sequence):
        (inner if row[0] in sequence.steps and row[1] in sequence.steps else outer).append(_edge(*row))
    lines = ["stateDiagram-v2", "    direction LR", "    state job {", "        direction LR"]
    lines += [f"        {line}" for line in inner]
    lines += ["    }", '    state "any state" as any_state', f"    [*] --> {State.IDLE.value}"]
    lines += [f"    {line}" for line in outer]
    lines += [f"    {end.value} --> [*]" for end in ends]
    return "\n".join(lines) + "\n"


def _drawn(sequence: Sequence) -> list[tuple[str, str, str]]:
    """Edges (source, target, label), with the rows that share all steps or all states folded into one."""
    rows, steps = sequence.rows(), set(sequence.steps)
    states = {row.source for row in rows}
    by_target: dict[tuple[Trigger, str], set[str]] = defaultdict(set)
    by_source: dict[tuple[Trigger, str], set[str]] = defaultdict(set)
    for row in rows:
        by_target[row.trigger, row.target].add(row.source)
        by_source[row.trigger, row.source].add(row.target)
    edges: list[tuple[str, str, str]] = []
    for row in rows:
        source, target = str(row.source), str(row.target)
        if by_target[row.trigger, row.target] == states:
            source = "any_state"
        elif row.source in steps and by_target[row.trigger, row.target] >= steps:
            source = "job"
        if by_source[row.trigger, row.source] == steps:
            target = "job"
        # To any step up to the one where it stands: one arrow says as much as all of them.
        if row.trigger is Trigger.AGAIN:
            source = target = "job"
        label = row.trigger.value + (f" [{row.guard.value}]" if row.guard.value else "")
        if (source, target, label) not in edges:
            edges.append((source, target, label))
    return edges


def _edge(source: str, target: str, label: str) -> str:
    return f"{source} --> {target} : {label}"
