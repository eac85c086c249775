"""The whole stack under fire: rehearsal in virtual time, faults, kills, days on end, and the audit of each.

Entered by fault_matrix, kill_campaign, soak and rig_study."""
