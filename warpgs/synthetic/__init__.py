"""Synthetic scenes: a ray caster, and the demo scene."""
