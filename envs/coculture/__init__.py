"""Two species in one vial: their growth rates against temperature.

Entered by the plant, and by whatever learns to hold a composition."""
