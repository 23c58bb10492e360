# syntax=docker/dockerfile:1
# The HTTP service on the CPU. `docker compose up` builds and runs it; see compose.yaml.

FROM python:3.11-slim AS build
RUN python -m venv /opt/cvthead
WORKDIR /source
COPY . .
RUN --mount=type=cache,target=/root/.cache/pip \
    /opt/cvthead/bin/pip install --disable-pip-version-check .

FROM python:3.11-slim
RUN useradd --uid 10001 --no-create-home --shell /usr/sbin/nologin cvthead \
    && install --directory --owner 10001 --mode 0700 /var/lib/cvthead
COPY --from=build /opt/cvthead /opt/cvthead
# HOME: the root file system is read-only, and libraries that want a cache find /tmp.
ENV PATH=/opt/cvthead/bin:$PATH \
    HOME=/tmp \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    CVTHEAD_HOST=0.0.0.0 \
    CVTHEAD_PORT=8000 \
    CVTHEAD_STORE=/var/lib/cvthead \
    CVTHEAD_LOG_FORMAT=json
USER 10001
WORKDIR /tmp
VOLUME /var/lib/cvthead
EXPOSE 8000
# Loading and the warm-up render take some seconds; ready is 503 until they are done.
HEALTHCHECK --interval=15s --timeout=5s --start-period=90s --retries=3 CMD \
    ["python", "-c", "import urllib.request as r; r.urlopen('http://127.0.0.1:8000/health/ready', timeout=4)"]
# As an array: SIGTERM reaches the service itself, which finishes what it has accepted.
CMD ["cvthead", "serve"]
