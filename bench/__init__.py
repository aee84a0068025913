"""Measurements that anyone can rerun: speed, memory and agreement with other programs."""
