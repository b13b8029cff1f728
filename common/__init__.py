"""What aircraft and ground share: messages, wire, bus, geometry, products."""
