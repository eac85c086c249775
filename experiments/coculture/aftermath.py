"""What the page of a run with two species lacks."""

from experiments.record.aftermath import INCOMPARABLE

INCOMPARABLE.append(
    lambda config: (
        "the growth of two species follows their share, and the model is of one species"
        if config.get("composition")
        else ""
    )
)
