"""Pages about finished runs: one run, or several compared. No page needs the network."""
