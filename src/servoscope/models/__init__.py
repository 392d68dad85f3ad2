"""The loop file and the plants behind it: physics, coefficients, linear systems."""
