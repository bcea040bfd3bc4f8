"""What changes the rigid body: payloads, links, the direction of gravity."""
