"""Why central cannot be reached, in words that name the next command.

Contract: pure; tells a name that does not resolve, a refused connection, a certificate that does not hold and a
peer that speaks no TLS apart, by what the operating system and OpenSSL say, not by their texts' wording.
"""

import socket
import ssl

import httpx

from sync.text import one_line

GOES_ON = "nothing is lost, it goes on by itself when central is back"
"""Of a daemon that runs on."""

_CERTIFICATE = {
    9: ("its certificate is not valid yet", "set this machine's clock: timedatectl"),
    10: ("its certificate has expired", "renew the certificate on central; if it is good, set this machine's clock"),
    18: ("its certificate is one that it made itself, and not the one that was pinned", "{enrol}"),
    19: ("its certificate comes from an authority that is not known here", "{authority}"),
    20: ("its certificate comes from an authority that is not known here", "{authority}"),
    21: ("its certificate comes from an authority that is not known here", "{authority}"),
    62: ("its certificate is for another name", "give the address by a name that the certificate has"),
    64: ("its certificate is for another address", "give the address by a name that the certificate has"),
}
"""By OpenSSL's code of a verification (`X509_V_ERR_...`)."""
_NEXT = {
    "enrol": "ask central's operator; where the certificate was made anew: vian station invite NAME there, "
    "then vian station enrol CODE --central URL here",
    "authority": "give the authority's certificate: SSL_CERT_FILE=FILE; if central made its certificate itself: "
    "vian station enrol CODE --central URL",
}


def why_unreachable(error: httpx.HTTPError | OSError, afterwards: str = GOES_ON) -> str:
    """What happened, and what to do next.

    Args:
        error: What was raised.
        afterwards: What becomes of what was asked for, once central is back.
    """
    cause = _cause(error)
    if isinstance(cause, ssl.SSLCertVerificationError):
        what, then = _CERTIFICATE.get(cause.verify_code, (f"its certificate does not hold: {cause.verify_message}", ""))
        return f"{what}. Next: {(then or _NEXT['authority']).format(**_NEXT)}"
    if isinstance(cause, ssl.SSLError):
        return f"what answers speaks no TLS that is understood here ({_said(cause)}). Next: check address and port"
    if isinstance(cause, socket.gaierror):
        return f"its name does not resolve ({_said(cause)}). Next: check the address, the link and DNS; {afterwards}"
    if isinstance(cause, ConnectionRefusedError):
        return f"nothing listens there (connection refused). Next: vian serve --role central there; {afterwards}"
    if isinstance(error, httpx.ProxyError):
        return f"the proxy refuses ({_said(error)}). Next: check HTTPS_PROXY and NO_PROXY; {afterwards}"
    return f"{_said(error)}. Next: check address and link; {afterwards}"


def _cause(error: BaseException) -> BaseException:
    """The operating system's or OpenSSL's error behind it; itself where there is none."""
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, OSError):
            return seen
        seen = seen.__cause__ or seen.__context__
    return error


def _said(error: BaseException) -> str:
    return one_line(str(error), 300).rstrip(".") or type(error).__name__
