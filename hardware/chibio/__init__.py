"""The driver of a Chi.Bio: from routes and JSON to samples, doses and faults of up to eight reactors.

Entered through `reactors`; bench commands use `procedures` and `preflight`. Knows no policy and no simulation."""
