"""The driver of a Chi.Bio: from routes and JSON to samples, doses and faults of up to eight reactors.

Control loops use `reactors`; bench commands use `procedures` and `preflight`. No policy or simulation is in here."""
