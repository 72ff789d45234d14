"""Options of the subcommands, without heavy imports: `--help` must be fast."""
