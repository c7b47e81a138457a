"""A Dask cluster as the options of the command line name it, and checks of these options."""

from __future__ import annotations

import ssl
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import urlsplit

from ..errors import InputError
from ..input_files import read_bytes
from ..printable import printable

LARGEST = 1_000_000  # bytes of a certificate or a key
EXAMPLE = "192.168.1.5:8786"
TLS_OPTIONS = "--tls-ca", "--tls-cert", "--tls-key"


@dataclass(frozen=True)
class Cluster:
    """The scheduler of a cluster, and the PEM files with which a client of tls:// and the scheduler know one another.

    authority : certificate of the authority that signed all certificates of the cluster
    certificate, key : of this client;  all three None: those of Dask's own configuration
    """

    address: str
    authority: Path | None = None
    certificate: Path | None = None
    key: Path | None = None

    def __str__(self) -> str:
        """Name the cluster as messages do."""
        return f"--scheduler {printable(self.address)}"

    def check(self) -> None:
        """Raise InputError if the address is none, or if a file is missing, is no certificate, or fits to no other."""
        if not _is_address(self.address):
            raise InputError(
                f"--scheduler: expected an address such as tcp://{EXAMPLE}, got '{printable(self.address)}'"
            )
        if find_spec("distributed") is None:
            raise InputError("--scheduler: needs Dask, which is not installed; run: pip install 'ommatid[cluster]'")
        given = [option for option, path in zip(TLS_OPTIONS, self._files(), strict=True) if path is not None]
        if not given:
            return
        if not self.address.startswith("tls://"):
            raise InputError(
                f"{given[0]}: expected --scheduler tls://HOST:PORT with it, got '{printable(self.address)}'"
            )
        missing = [option for option in TLS_OPTIONS if option not in given]
        if missing:
            raise InputError(f"{missing[0]}: expected all of {', '.join(TLS_OPTIONS)}, got only {', '.join(given)}")
        self._check_files()

    def _files(self) -> tuple[Path | None, Path | None, Path | None]:
        return self.authority, self.certificate, self.key

    def _check_files(self) -> None:
        names = dict(zip(TLS_OPTIONS, self._files(), strict=True))
        for option, path in names.items():
            try:
                read_bytes(path or Path(), LARGEST)
            except OSError as error:
                reason = f"cannot be read ({error.strerror})"
                raise InputError(f"{option}: {printable(path)} {reason}; expected a file in PEM format") from error
            except InputError as error:
                raise InputError(f"{option}: {error}") from error
        context = ssl.create_default_context()
        try:
            context.load_verify_locations(str(self.authority))
        except (ssl.SSLError, ValueError) as error:
            raise InputError(
                f"--tls-ca: {printable(self.authority)}: expected a certificate in PEM format, got something else"
            ) from error
        try:
            context.load_cert_chain(str(self.certificate), str(self.key), password=b"")  # else OpenSSL asks for one
        except (ssl.SSLError, ValueError) as error:
            raise InputError(
                f"--tls-cert, --tls-key: {printable(self.certificate, 80)}, {printable(self.key, 80)}: expected a"
                " certificate and its own key without a password, both in PEM format"
            ) from error


def _is_address(text: str) -> bool:
    try:
        parts = urlsplit(text)
        return parts.scheme in ("tcp", "tls") and bool(parts.hostname and parts.port) and not parts.path
    except ValueError:
        return False
