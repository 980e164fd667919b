# dronevio on Debian, set up by `make setup`:
#
#     docker build -t dronevio .
#     docker run --rm -v "$PWD:/work" -w /work dronevio run
FROM debian:bookworm-slim AS system
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
        ca-certificates git make python3 libegl1 libgl1-mesa-dri libopengl0 \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --create-home --uid 1000 --shell /bin/bash dronevio \
    && install -d -o dronevio -g dronevio /opt/dronevio
USER dronevio

FROM system
WORKDIR /opt/dronevio
COPY --chown=dronevio:dronevio . .
RUN UV_NO_CACHE=1 make setup
ENTRYPOINT ["/opt/dronevio/.venv/bin/dronevio"]
CMD ["--help"]
