"""Live devices: links that are opened, read and watched in threads. The bytes themselves are for `air.sensors`."""
