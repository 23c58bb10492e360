"""Everything an operator can set; ``docs/service.md`` has the same table."""

from __future__ import annotations

import ipaddress
import os
import re
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, SecretStr, ValidationError, field_validator, model_validator
from pydantic_settings import (
    BaseSettings,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)

from cvthead.errors import InputError

PREFIX = "CVTHEAD_"
FILE_VARIABLE = f"{PREFIX}SETTINGS_FILE"
LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")
TENANT_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,31}")
MIN_KEY_LENGTH = 16

# In the environment lists are written with commas: CVTHEAD_CORS_ORIGINS=https://a.example,...
Names = Annotated[tuple[str, ...], NoDecode]
Keys = Annotated[tuple[SecretStr, ...], NoDecode]


class Settings(BaseSettings):
    """Settings of the service. Immutable.

    Sources, the first wins: arguments, environment variables ``CVTHEAD_<NAME>``, the TOML file
    named by ``CVTHEAD_SETTINGS_FILE``, the defaults below.
    """

    model_config = SettingsConfigDict(
        env_prefix=PREFIX,
        frozen=True,
        extra="forbid",
        hide_input_in_errors=True,  # an error must not print a key
        allow_inf_nan=False,
    )

    host: str = Field("127.0.0.1", description="Address to listen on.")
    port: int = Field(8000, ge=0, le=65535, description="Port to listen on; 0 takes a free one.")
    open_network: bool = Field(
        False,
        description="Allow to listen beyond loopback without keys, for example in a container "
        "whose port is published to loopback only.",
    )
    keys: Keys = Field(
        (),
        description="API keys as `name:key`, keys of at least 16 characters. A name owns its "
        "avatars; several keys of one name allow to change a key without a gap.",
    )
    consent_required: bool | None = Field(
        None,
        description="Refuse an upload that does not say `consent=true`. Default: as soon as "
        "keys are set.",
    )
    preset: Literal["open", "official"] = Field(
        "open", description="Model to load: `open`, or `official` after `cvthead import-official`."
    )
    model: Path | None = Field(
        None,
        description="Folder of another model of the preset than the packaged (`official`: the "
        "imported) one.",
    )
    threads: int = Field(
        0,
        ge=0,
        le=1024,
        description="Threads of each neural network; 0 is one per core, of the open preset at "
        "most 4.",
    )
    providers: Names = Field(
        (),
        description="onnxruntime's execution providers for the trained networks, the preferred "
        "one first, such as `CUDAExecutionProvider` with the package onnxruntime-gpu. Default: "
        "the CPU, which alone is tested.",
    )
    store: Path = Field(
        Path("avatars"), description="Folder of the stored avatars; created when missing."
    )
    store_max_avatars: int = Field(
        10_000, ge=1, description="Avatars that the store holds at most; then 507 `store_full`."
    )
    memory_bytes: int = Field(
        256 * 2**20, ge=0, description="Bytes of avatars kept in memory; others are read from disk."
    )
    lifetime_seconds: float = Field(
        7 * 86400, gt=0, description="Lifetime of an avatar whose upload does not give one."
    )
    lifetime_max_seconds: float = Field(
        30 * 86400, gt=0, description="Longest lifetime that an upload can ask for."
    )
    purge_seconds: float = Field(
        60, gt=0, description="Seconds between removals of expired avatars from the store."
    )
    max_body_bytes: int = Field(
        20 * 10**6, ge=1024, description="Largest request body, counted while it is received."
    )
    receive_seconds: float = Field(
        60,
        gt=0,
        le=3600,
        description="Longest time for a request's headers, and again for its body, to arrive; then "
        "408 `request_timeout`.",
    )
    send_seconds: float = Field(
        60,
        gt=0,
        le=3600,
        description="Longest time in which a client takes nothing of its answer; then the "
        "connection is closed. Streams have their acknowledgement window instead.",
    )
    encode_queue: int = Field(
        8, ge=1, description="Uploads that may wait; one more gets 503 `overloaded`."
    )
    render_queue: int = Field(
        64, ge=1, description="Renders that may wait; one more gets 503 `overloaded`."
    )
    max_batch: int = Field(8, ge=1, le=256, description="Waiting renders painted at once at most.")
    rate_limit: int = Field(
        6000,
        ge=0,
        description="Requests per minute and key (per client address without keys); 0 sets no "
        "limit.",
    )
    ticket_seconds: float = Field(
        30, gt=0, le=600, description="Lifetime of a single-use WebSocket ticket."
    )
    max_streams: int = Field(32, ge=1, description="WebSocket streams open at once.")
    cors_origins: Names = Field(
        (), description="Origins of other sites' pages that may call the API; `*` is any."
    )
    websocket_origins: Names = Field(
        (), description="Origins, beside the service's own, that may open a stream; `*` is any."
    )
    allowed_hosts: Names = Field(
        (),
        description="Host names that requests may use, `*.example.com` too. Default: loopback "
        "names when listening on loopback, else any.",
    )
    trusted_proxies: Names = Field(
        (), description="Addresses of proxies whose `X-Forwarded-*` headers are believed."
    )
    metrics_public: bool = Field(
        False, description="Serve `/metrics` without a key although keys are set."
    )
    docs: bool = Field(
        False,
        description="Serve the interactive API page `/docs`. The browser loads its scripts from "
        "cdn.jsdelivr.net; everything else works offline.",
    )
    c2pa_certificates: Path | None = Field(
        None,
        description="PEM file of the certificate chain with which stills are signed as C2PA "
        "describes; needs the extra `c2pa`. Default: they are not signed.",
    )
    c2pa_private_key: Path | None = Field(
        None, description="PEM file of the private key of the first certificate, not encrypted."
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="Least severe log lines to write."
    )
    log_format: Literal["console", "json"] = Field("console", description="Form of the log lines.")
    drain_seconds: float = Field(
        30, ge=0, description="Longest wait for work in flight after SIGTERM."
    )

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        file = os.environ.get(FILE_VARIABLE)
        toml = (TomlConfigSettingsSource(settings_cls, Path(file)),) if file else ()
        return (init_settings, env_settings, *toml)

    @field_validator(
        "keys",
        "providers",
        "cors_origins",
        "websocket_origins",
        "allowed_hosts",
        "trusted_proxies",
        mode="before",
    )
    @classmethod
    def _comma_separated(cls, value: Any) -> Any:
        if isinstance(value, str):
            return tuple(part.strip() for part in value.split(",") if part.strip())
        return value

    @field_validator("keys")
    @classmethod
    def _well_formed(cls, value: tuple[SecretStr, ...]) -> tuple[SecretStr, ...]:
        secrets = []
        for entry in value:
            name, colon, secret = entry.get_secret_value().partition(":")
            if not colon or not TENANT_NAME.fullmatch(name):
                raise ValueError("write keys as name:key, names of a-z, 0-9, - and _")
            if len(secret) < MIN_KEY_LENGTH or not secret.isascii() or not secret.isprintable():
                raise ValueError(f"the key of {name} needs {MIN_KEY_LENGTH} ASCII characters")
            secrets.append(secret)
        if len(set(secrets)) < len(secrets):
            raise ValueError("a key is there twice")
        return value

    @field_validator("allowed_hosts")
    @classmethod
    def _host_patterns(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for pattern in value:
            if "*" in pattern.removeprefix("*.") and pattern != "*":
                raise ValueError("hosts are written as example.com, *.example.com or *")
        return tuple(pattern.lower() for pattern in value)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.lifetime_seconds > self.lifetime_max_seconds:
            raise ValueError("lifetime_seconds is longer than lifetime_max_seconds")
        if (self.c2pa_certificates is None) != (self.c2pa_private_key is None):
            raise ValueError("c2pa_certificates and c2pa_private_key go together")
        if not (self.on_loopback or self.keys or self.open_network):
            raise ValueError(
                f"{self.host} can be reached from other machines and no keys are set; set "
                f"{PREFIX}KEYS=name:key, or listen on 127.0.0.1, or allow it with open_network"
            )
        return self

    @property
    def on_loopback(self) -> bool:
        """Whether only this machine can reach the service."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    @property
    def consent(self) -> bool:
        """Whether uploads must state consent."""
        return bool(self.keys) if self.consent_required is None else self.consent_required

    @property
    def hosts(self) -> tuple[str, ...]:
        """Allowed host names; on loopback the default stops DNS rebinding."""
        default = (*LOOPBACK_NAMES, self.host) if self.on_loopback else ("*",)
        return self.allowed_hosts or default


def load_settings(**arguments: Any) -> Settings:
    """Settings from all sources; ``arguments`` that are None are not given.

    Raises:
        InputError: a value is missing, malformed or out of range, or the file cannot be read.
    """
    file = os.environ.get(FILE_VARIABLE)
    if file and not Path(file).is_file():
        raise InputError(f"{FILE_VARIABLE}: {file} is not a file", hint="correct the path")
    try:
        return Settings(**{name: v for name, v in arguments.items() if v is not None})
    except ValidationError as error:
        found = error.errors(include_url=False, include_context=False, include_input=False)
        text = "; ".join(
            f"{_name(e['loc'])}{e['msg'].removeprefix('Value error, ')}" for e in found
        )
        raise InputError(f"settings: {text}", hint="docs/service.md has all settings") from None
    except (OSError, ValueError) as error:  # of the TOML file
        raise InputError(f"{file}: {error}", hint="correct the settings file") from None


def _name(location: tuple[int | str, ...]) -> str:
    return ".".join(map(str, location)) + ": " if location else ""
