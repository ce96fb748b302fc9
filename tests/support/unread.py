"""Readers that never read."""

import asyncio
import socket


async def unread_websocket(port, path="/", *headers):
    """A WebSocket whose socket takes little and is never read."""
    sock = socket.socket()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    sock.setblocking(False)
    loop = asyncio.get_running_loop()
    await loop.sock_connect(sock, ("127.0.0.1", port))
    upgrade = (f"GET {path} HTTP/1.1", f"Host: 127.0.0.1:{port}", "Upgrade: websocket", "Connection: Upgrade")
    key = ("Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version: 13")
    await loop.sock_sendall(sock, "\r\n".join((*upgrade, *key, *headers, "", "")).encode())
    return sock
