"""Commands, a module each with ``run(arguments, about)``: parse, call, print; no logic."""
