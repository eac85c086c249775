"""Links to devices: HTTP, serial line, MQTT, and the lock that excludes a second client.

Entered by drivers. Knows bytes, no device."""
