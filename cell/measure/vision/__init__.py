"""Images to numbers: stripe centres and board points, each with its own uncertainty or the reason of its refusal."""
