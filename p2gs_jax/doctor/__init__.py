"""What works on this machine: nothing here is imported before it is tried."""
