"""The programs: command line, doctor, precompilation."""
