"""What gets alarms by HTTP in tests."""

import contextlib
import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class Receiver:
    """An HTTP server that answers with what it is told, and keeps what came."""

    def __init__(self, answers=(), wait_s=0.0):
        self.requests, self.answers, self.wait_s = [], list(answers), wait_s
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self):
                body = self.rfile.read(int(self.headers["Content-Length"]))
                outer.requests.append((self.path, dict(self.headers), body))
                time.sleep(outer.wait_s)
                with contextlib.suppress(OSError):
                    self.send_response(outer.answers.pop(0) if outer.answers else 204)
                    self.send_header("Content-Length", "0")
                    self.end_headers()

            def log_message(self, *_args):
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.port = self._server.server_address[1]

    def __enter__(self):
        threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True).start()
        return self

    def __exit__(self, *_):
        self._server.shutdown()
        self._server.server_close()

    @property
    def types(self):
        return [json.loads(body)["type"] for _, _, body in self.requests]
