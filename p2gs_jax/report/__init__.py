"""Pages about finished runs: one run explained, or several compared. No page needs the network."""
