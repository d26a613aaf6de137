"""What travels between station and central: messages, records, signatures, and what both sides say of streams."""
