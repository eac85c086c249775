"""The interlock between every controller and every pump.

The code that builds a closed loop uses it. It handles measurements and receipts, and knows no device."""
