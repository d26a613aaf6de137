"""ViAn (migrations)."""
