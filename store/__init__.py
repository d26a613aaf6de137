"""ViAn (store)."""
