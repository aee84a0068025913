"""Farms: many fits, several at a time, on the engines that exist."""
