"""Lengths of time and numbers of bytes as people read them."""


def span(seconds: float) -> str:
    """A length of time in its two largest units.

    >>> span(93784), span(59.6), span(0.2)
    ('1 d 2 h', '1 min', '0 s')
    """
    whole = round(seconds)
    parts = [(whole // 86_400, "d"), (whole // 3_600 % 24, "h"), (whole // 60 % 60, "min"), (whole % 60, "s")]
    first = next((place for place, (number, _) in enumerate(parts) if number), len(parts) - 1)
    return " ".join(f"{number} {unit}" for number, unit in parts[first : first + 2] if number) or "0 s"


def size_text(size: float) -> str:
    """A number of bytes for people.

    >>> size_text(812), size_text(81_234), size_text(3_500_000_000)
    ('812 B', '81.2 kB', '3.5 GB')
    """
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.0f} B" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} GB"
