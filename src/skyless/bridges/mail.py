"""``smtp://[USER@]HOST:PORT?to=…&from=…`` and ``smtps:``: a mail when an alarm is raised, another when it has ended."""

import re
import smtplib
import ssl
import time
from email.message import EmailMessage
from email.utils import formatdate
from functools import partial
from hashlib import sha256
from typing import Final

from skyless.bridges._deliveries import TIMEOUT_S, AlarmTarget, Delivery, Open, RefusedError, read_secret
from skyless.bridges.target import BridgeContext, TargetUrl
from skyless.run.mqtt.address import is_loopback

_ADDRESS: Final = re.compile(r"[^\s@,<>]+@[^\s@,<>]+")


class Mail(AlarmTarget):
    """Sends mails to one or more people through one server."""

    def __init__(self, url: TargetUrl, context: BridgeContext) -> None:
        super().__init__(url.text, context.log, frozenset({"raised", "ended"}))
        self._host, user = url.host(""), url.netloc().rpartition("@")[0]
        is_tls = url.scheme == "smtps"
        self._port = url.port(465 if is_tls else 25)
        self._starts_tls = not is_tls and url.has("starttls")
        self._to = url.text_option("to").replace(" ", "").split(",")
        self._from = url.text_option("from") or self._to[0]
        name = url.text_option("password_file")
        if not self._host or ":" in user:
            raise url.wrong(f"{url.scheme}://[USER@]HOST:PORT?to=NAME@HOST; password_file=FILE has the password")
        for address in (*self._to, self._from):
            if not _ADDRESS.fullmatch(address):
                raise url.wrong(f"with to= and from= as NAME@HOST, several to= with commas; {address!r} is none")
        if name and not user:
            raise url.wrong(f"{url.scheme}://USER@HOST, as a password is given")
        if name and not (is_tls or self._starts_tls or is_loopback(self._host)):
            raise url.wrong("smtps: or ?starttls, as a password is given")
        self._tls = ssl.create_default_context()
        self._connect = partial(smtplib.SMTP_SSL, context=self._tls) if is_tls else smtplib.SMTP
        self._user, self._password = user, read_secret(url.text, "password_file", name) if name else ""

    def attempt(self, delivery: Delivery, on_open: Open) -> None:
        """Send once."""
        server = self._connect(self._host, self._port, timeout=TIMEOUT_S)
        try:
            with server:
                on_open(server.sock)
                if self._starts_tls:
                    server.starttls(context=self._tls)
                    on_open(server.sock)  # it is another one now
                if self._user:
                    server.login(self._user, self._password)
                waiting = [address for address in self._to if address not in delivery.reached]
                refused = server.send_message(self._mail(delivery), to_addrs=waiting)
                delivery.reached.update(set(waiting) - refused.keys())
                if refused:
                    raise smtplib.SMTPRecipientsRefused(refused)
        except smtplib.SMTPAuthenticationError:
            raise ConnectionError("the server does not accept user and password") from None
        except smtplib.SMTPRecipientsRefused as error:
            if all(code >= 500 for code, _ in error.recipients.values()):
                raise RefusedError(str(error)) from None
            raise
        except smtplib.SMTPResponseException as error:
            if error.smtp_code >= 500:
                raise RefusedError(str(error)) from None
            raise

    def _mail(self, delivery: Delivery) -> EmailMessage:
        alarm, site = delivery.alarm, self.site
        where = "" if site is None else site.name
        mail = EmailMessage()
        ended = "" if delivery.what == "raised" else "ended: "
        mail["Subject"] = _header(f"{ended}{alarm.name} [{alarm.severity}] {where}")[:200]
        mail["From"], mail["To"] = self._from, ", ".join(self._to)
        mail["Date"] = formatdate(localtime=True)
        mail["Message-ID"] = f"<{sha256(delivery.key.encode()).hexdigest()[:32]}@skyless>"
        mail["Auto-Submitted"] = "auto-generated"
        times = {"Since": alarm.since_unix_s, "Raised": alarm.unix_s, "Ended": alarm.ended_unix_s}
        facts = {"Site": where, "Place": alarm.place, "Severity": alarm.severity}
        facts |= {name: _time(at) for name, at in times.items() if at}
        lines = (f"{name}: {value}" for name, value in facts.items() if value)
        simulated = "\nThis site is simulated.\n" if site is not None and site.simulated else ""
        mail.set_content(f"{alarm.sentence}.\n\n" + "\n".join(lines) + f"\n{simulated}\n{alarm.id}\n")
        return mail


def _header(text: str) -> str:
    """A text as a header's value. In Python before 3.11.10, a name ``=?utf-8?q?=0D=0ABcc:…?=`` could add a header."""
    return " ".join("".join(one if one.isprintable() else " " for one in text).replace("=?", "= ?").split())


def _time(unix_s: float) -> str:
    try:
        return time.strftime("%Y-%m-%d %H:%M:%S %Z", time.localtime(unix_s))
    except (OverflowError, ValueError, OSError):
        return f"{unix_s:g} s, which is no time"


make_target: Final = Mail
