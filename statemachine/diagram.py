"""The sequence as a Mermaid state diagram, generated from the machine itself.

Run `python -m statemachine.diagram` to print it. Transitions that leave every state, or every step, are drawn once.
"""

from __future__ import annotations

from collections import defaultdict

from statemachine.sequence import ENDS, STEPS, Sequence, State, Transition, Trigger


def mermaid() -> str:
    """The diagram as `stateDiagram-v2` text, without a fence, ending in a newline."""
    inner: list[str] = []
    outer: list[str] = []
    for row in _drawn(Sequence().rows()):
        (inner if row[0] in _STEP_NAMES and row[1] in _STEP_NAMES else outer).append(_edge(*row))
    lines = ["stateDiagram-v2", "    direction LR", "    state job {", "        direction LR"]
    lines += [f"        {line}" for line in inner]
    lines += ["    }", '    state "any state" as any_state', f"    [*] --> {State.IDLE.value}"]
    lines += [f"    {line}" for line in outer]
    lines += [f"    {end.value} --> [*]" for end in ENDS]
    return "\n".join(lines) + "\n"


_STEP_NAMES = frozenset(step.value for step in STEPS)


def _drawn(rows: tuple[Transition, ...]) -> list[tuple[str, str, str]]:
    """Edges (source, target, label), with the rows that share all steps or all states folded into one."""
    by_target: dict[tuple[Trigger, State], set[State]] = defaultdict(set)
    by_source: dict[tuple[Trigger, State], set[State]] = defaultdict(set)
    for row in rows:
        by_target[row.trigger, row.target].add(row.source)
        by_source[row.trigger, row.source].add(row.target)
    edges: list[tuple[str, str, str]] = []
    for row in rows:
        source, target = row.source.value, row.target.value
        if by_target[row.trigger, row.target] == set(State):
            source = "any_state"
        elif row.source in STEPS and by_target[row.trigger, row.target] >= set(STEPS):
            source = "job"
        if by_source[row.trigger, row.source] == set(STEPS):
            target = "job"
        label = row.trigger.value + (f" [{row.guard.value}]" if row.guard.value else "")
        if (source, target, label) not in edges:
            edges.append((source, target, label))
    return edges


def _edge(source: str, target: str, label: str) -> str:
    return f"{source} --> {target} : {label}"


if __name__ == "__main__":
    print(mermaid(), end="")
