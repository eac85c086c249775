"""The whole stack under fire: faults, kills, days on end, a study on the rig, and the rehearsal in virtual time."""
