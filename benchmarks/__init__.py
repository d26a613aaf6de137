"""ViAn (benchmarks)."""
