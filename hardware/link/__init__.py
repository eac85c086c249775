"""Links to devices: HTTP, serial line, MQTT, and the lock that excludes a second client.

Drivers use it. It handles bytes and knows no device."""
