"""What each subcommand can be asked, without what answers it: `--help` must come at once."""
