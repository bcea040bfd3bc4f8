"""Between motor and link: rotor inertia, elasticity, backlash, torque ripple."""
