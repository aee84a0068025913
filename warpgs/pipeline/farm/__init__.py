"""Farms: many fits, several at a time, on this machine or a cluster."""
