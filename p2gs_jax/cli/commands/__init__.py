"""The subcommands, one module each: `run(options)` returns the exit code."""
