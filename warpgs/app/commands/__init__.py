"""Commands: each module has ``run(arguments, about)``, which parses, calls and prints; no logic."""
