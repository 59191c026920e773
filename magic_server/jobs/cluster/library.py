"""Dask.distributed, loaded when it is wanted, and held to what this project does with it."""

from __future__ import annotations

import logging
import ssl
from typing import TYPE_CHECKING

from magic_core.errors import ConfigError
from magic_server.jobs.config import ClusterTls

if TYPE_CHECKING:
    from distributed import Security


def require_distributed(*, field: str) -> None:
    """Load the library; ConfigError with the remedy where it is not installed.

    `field` is the setting that asked for it.
    """
    try:
        import distributed
    except ImportError as error:
        raise ConfigError.field(
            field, f"{error}; install it: pip install 'magic-slam[cluster]'"
        ) from error
    from dask import config

    # What the library says of its own goes where everything else goes, and only what matters.
    logger = logging.getLogger(distributed.__name__)
    for handler in list(logger.handlers):
        logger.removeHandler(handler)
    logger.propagate = True
    for name in ("distributed", "distributed.client", "distributed.worker", "bokeh"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    # A large pose graph is one message; that is meant.
    config.set({"distributed.admin.large-graph-warning-threshold": "1 GiB"})


def security_of(certificates: ClusterTls, *, field: str) -> Security | None:
    """What Dask is told of the certificates; None without any.

    Raises ConfigError naming the files where they cannot be used. `field` is what the setting is
    called.
    """
    if not certificates.enabled:
        return None
    from distributed import Security

    ca, certificate, key = map(str, (certificates.ca, certificates.certificate, certificates.key))
    try:
        context = ssl.create_default_context(cafile=ca)
        context.load_cert_chain(certificate, key, password=lambda: b"")
    except OSError as error:  # ssl.SSLError is one
        raise ConfigError.field(
            field, f"{ca}, {certificate} and {key} cannot be used: {error}; expected PEM files"
        ) from error
    return Security(
        tls_ca_file=ca,
        tls_client_cert=certificate,
        tls_client_key=key,
        tls_worker_cert=certificate,
        tls_worker_key=key,
        require_encryption=True,
    )
