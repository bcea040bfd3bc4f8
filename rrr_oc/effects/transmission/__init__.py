"""What stands between motor and link: rotor inertia, elasticity, play, gear ripple."""
