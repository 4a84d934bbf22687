"""What the chain is held against: scenes with known truth, data sets, metrics, rivals, tables."""
