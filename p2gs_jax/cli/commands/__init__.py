"""What each subcommand does, one file each: `run(options)` returns the exit code."""
