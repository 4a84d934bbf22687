"""What photographs are worth and what a machine has, told in seconds before a run of minutes."""
