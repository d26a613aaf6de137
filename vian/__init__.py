"""ViAn (vian)."""
