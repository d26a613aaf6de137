"""ViAn (sync)."""
