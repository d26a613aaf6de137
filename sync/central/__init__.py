"""Central's side: who may speak, what is stored, what is answered and what is refused."""
