"""Text that the other side, or a stranger between, wrote: made fit for one line of a log or a terminal.

Contract: pure.
"""


def one_line(text: str, length_max: int) -> str:
    r"""The text in one line that is safe to print, cut to a length.

    >>> one_line("<h1>Log in\x1b[2J</h1>\n  please", 40)
    '<h1>Log in?[2J</h1> please'
    """
    line = " ".join(text.split())
    return "".join(letter if letter.isprintable() else "?" for letter in line)[:length_max]
