"""Reason why the page of a run with two species has no comparison with a growth model."""

from experiments.record.aftermath import INCOMPARABLE

INCOMPARABLE.append(
    lambda config: (
        "the growth of two species depends on their composition, but the model has one species"
        if config.get("composition")
        else ""
    )
)
