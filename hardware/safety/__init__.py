"""The interlock between every controller and every pump.

Entered by the closed loop alone. Knows measurements and receipts, no device."""
