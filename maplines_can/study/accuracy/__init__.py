"""How well each representation of a line stands for its true distribution."""
