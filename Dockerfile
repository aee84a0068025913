# warpgs in a container, for the CPU or for NVIDIA GPUs:
#   docker build --target cpu --tag warpgs:cpu .
#   docker build --target cuda --tag warpgs:cuda .
#   docker run --gpus all --volume "$PWD:/data" warpgs:cuda farm scenes --out results
# Nothing runs as root but the installation of the system's libraries.
# Python 3.11.16, all architectures
FROM python:3.11-slim-bookworm@sha256:a36c24f9cbdf4fd0f52d67f0823eeac19c2028c637cecc392d97f980d4fec56b AS base
# libgomp: threads
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libglib2.0-0 libgomp1 \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --create-home --uid 1000 warpgs \
    && install --directory --owner warpgs /opt/warpgs /data
USER warpgs
ENV PATH=/opt/warpgs/venv/bin:$PATH WARP_CACHE_PATH=/opt/warpgs/kernels PYTHONSAFEPATH=1
RUN python3 -m venv /opt/warpgs/venv && mkdir -p /opt/warpgs/kernels
COPY --chown=warpgs pyproject.toml constraints.txt README.md LICENSE /opt/warpgs/source/
COPY --chown=warpgs warpgs /opt/warpgs/source/warpgs

FROM base AS cpu
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
RUN pip install --no-cache-dir --constraint /opt/warpgs/source/constraints.txt --index-url "$TORCH_INDEX" torch
RUN pip install --no-cache-dir --constraint /opt/warpgs/source/constraints.txt "/opt/warpgs/source[ray]"
# kernels for the CPU, into the image
RUN warpgs doctor --warm
WORKDIR /data
ENTRYPOINT ["warpgs"]
CMD ["--help"]

FROM base AS cuda
# PyPI's torch for Linux brings its CUDA libraries
RUN pip install --no-cache-dir --constraint /opt/warpgs/source/constraints.txt torch
RUN pip install --no-cache-dir --constraint /opt/warpgs/source/constraints.txt "/opt/warpgs/source[ray]"
# kernels for the CPU, which scores on every machine; those for the GPU are compiled at the first start, as there is none now
RUN warpgs doctor --warm
WORKDIR /data
ENTRYPOINT ["warpgs"]
CMD ["--help"]
