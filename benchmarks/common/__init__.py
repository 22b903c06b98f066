"""What the benchmarks share: where data lies, the list of photo sets, how a set is read, and how figures are shown."""
