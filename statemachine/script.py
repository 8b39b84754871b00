"""What a script may do between the steps of a run: look at a result, and decide on a refusal."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from statemachine.policy import Failure


@dataclass(frozen=True)
class Again:
    """The decision to go on from a step, that was refused or an earlier one, and why, for the journal."""

    step: str
    why: str


@dataclass(frozen=True)
class Script:
    """`after` maps a step's name to what is called with its result before the next step begins; what it raises ends
    the run as if the step had raised it. `on_refusal` is called with the name of the step that was refused and the
    failure: it gives `Again`, or None to let the run end; after `most` decisions about one step the run ends without
    asking. Both run with the cell at rest, for as long as they like.
    """

    after: Mapping[str, Callable[[object], None]] = field(default_factory=dict)
    on_refusal: Callable[[str, Failure], Again | None] | None = None
    most: int = 3

    @property
    def idle(self) -> bool:
        """Whether it does nothing at all."""
        return not self.after and self.on_refusal is None


NO_SCRIPT = Script()
"""Nobody looks between the steps, and a refusal ends the run."""
