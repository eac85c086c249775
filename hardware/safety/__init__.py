"""The interlock between every controller and every pump.

Entered by whatever assembles a closed loop. Knows measurements and receipts, no device."""
