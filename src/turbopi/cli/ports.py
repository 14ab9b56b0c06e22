"""Whether a port can be listened on."""

import errno
import socket


def why_not_free(host: str, port: int) -> str | None:
    """None if a server could listen there now, else the system's reason.

    As the server does, on all addresses of `host`; this machine needn't have each of them ("localhost" without IPv6).
    """
    not_here, bound = None, False
    try:
        found = socket.getaddrinfo(host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except OSError as error:
        return _said(error)
    for family, kind, protocol, _, address in found:
        try:
            with socket.socket(family, kind, protocol) as listener:
                listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                if family == socket.AF_INET6:
                    listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
                listener.bind(address)
                bound = True
        except OSError as error:
            if error.errno not in (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT):
                return _said(error)
            not_here = _said(error)
    return None if bound else not_here


def _said(error: OSError) -> str:
    return error.strerror or str(error)
