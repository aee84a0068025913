"""Studies that settled one question each; what a release quotes is measured by the modules of `bench` itself."""
