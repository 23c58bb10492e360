"""C2PA manifests (content credentials, https://spec.c2pa.org) for the stills that are sent.

The signature says who vouches for a picture's XMP mark, which anybody could write or change. It
needs the extra ``c2pa``, a certificate and its key; without them nothing here is imported.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncGenerator
from contextlib import aclosing
from dataclasses import replace
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from cvthead.errors import InputError
from cvthead.images import encode_image
from cvthead.provenance import SourceType
from service.engine import Rendered

# Algorithms of the C2PA specification 2.2, section 13.2.1, by the bits of the key's curve.
_CURVES = {256: "es256", 384: "es384", 521: "es512"}


class StillSigner:
    """Signs PNG, JPEG and WebP files. Safe to share between threads.

    Args:
        certificates: PEM file of the signer's certificate and those up to the authority's.
        private_key: PEM file of its key, not encrypted: EC (P-256, P-384, P-521), Ed25519 or RSA.

    Raises:
        InputError: the extra is not installed, a file cannot be read, or the two do not fit.
    """

    def __init__(self, certificates: Path, private_key: Path) -> None:
        try:
            import c2pa
            import cryptography  # noqa: F401  (c2pa-python depends on it)
        except ModuleNotFoundError as error:
            raise InputError(
                f"signing needs the package {error.name}",
                hint='install it with pip install "cvthead[c2pa]", or unset c2pa_certificates',
            ) from error
        self._c2pa = c2pa
        chain, key = _read(certificates), _read(private_key)
        try:
            info = c2pa.C2paSignerInfo(_algorithm(key), chain, key, None)
            self._signer = c2pa.Signer.from_info(info)
            # The first one verifies what it signed: that finds a key of another certificate.
            self._context = self._new_context(verify=True)
            pixel = encode_image(np.zeros((1, 1, 3), np.uint8))
            self.sign(pixel, "image/png", SourceType.GENERATED)
        except (c2pa.C2paError, ValueError, TypeError) as error:
            raise InputError(
                f"cannot sign with {certificates} and {private_key}: {error}",
                hint="give the certificate chain and its unencrypted private key as PEM files",
            ) from error
        self._context = self._new_context(verify=False)

    def sign(self, data: bytes, media_type: str, source: SourceType) -> bytes:
        """The picture with a manifest that says how it was made.

        Args:
            data: a PNG, JPEG or WebP file.
            source: what its XMP mark says.
        """
        signed = BytesIO()
        builder = self._c2pa.Builder(_manifest(source), context=self._context)
        builder.sign(self._signer, media_type, BytesIO(data), signed)
        return signed.getvalue()

    def _new_context(self, *, verify: bool) -> Any:
        settings = {
            # A thumbnail would be larger than the picture and take most of the time.
            "builder": {"thumbnail": {"enabled": False}},
            # Whom to trust is the reader's decision.
            "verify": {"verify_after_sign": verify, "verify_trust": False},
        }
        return self._c2pa.Context(settings=self._c2pa.Settings.from_dict(settings))


async def signed(signer: StillSigner | None, picture: Rendered) -> Rendered:
    """The picture, signed in a thread if signing is set up."""
    if signer is None:
        return picture
    begin = time.perf_counter()
    data = await asyncio.to_thread(signer.sign, picture.data, picture.media_type, picture.source)
    timings = picture.timings | {"sign": (time.perf_counter() - begin) * 1000}
    return replace(picture, data=data, timings=timings)


async def all_signed(
    signer: StillSigner | None, pictures: AsyncGenerator[Rendered, None]
) -> AsyncGenerator[Rendered, None]:
    """Each of the pictures as :func:`signed` gives it."""
    async with aclosing(pictures):
        async for picture in pictures:
            yield await signed(signer, picture)


def _manifest(source: SourceType) -> str:
    software = {"name": "cvthead", "version": version("cvthead")}
    created = {
        "action": "c2pa.created",
        "digitalSourceType": str(source),
        "softwareAgent": software,
    }
    actions = {"label": "c2pa.actions.v2", "data": {"actions": [created]}}
    return json.dumps({"claim_generator_info": [software], "assertions": [actions]})


def _algorithm(key: bytes) -> str:
    """The name of the signature algorithm that a PEM key is for.

    Raises:
        ValueError, TypeError: it is no key, or encrypted, or of another kind.
    """
    from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    found = load_pem_private_key(key, None)
    if isinstance(found, ec.EllipticCurvePrivateKey) and found.curve.key_size in _CURVES:
        return _CURVES[found.curve.key_size]
    if isinstance(found, ed25519.Ed25519PrivateKey):
        return "ed25519"
    if isinstance(found, rsa.RSAPrivateKey):
        return "ps256"
    raise ValueError("keys of this kind cannot sign")


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(
            f"cannot read {path}: {error.strerror}", hint="check the path and its permissions"
        ) from error
