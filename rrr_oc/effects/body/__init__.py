"""Changes of the rigid body: payload, links, direction of gravity."""
