"""The springs of a design as parts that a maker can wind: wire, coils, stress, life, mass, and why one cannot be built.

`wire` has the steel, `helical` the formulae of three makes of helical springs, `fatigue` their life, `tolerances` how well they are met,
`limits` what a task allows, `sizing` the lightest spring within that, and `order_list` the parts of a design.
"""
