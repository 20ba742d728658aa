# pnu on the CPU:
#   docker build -t pnu .
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" pnu scan input=scan.ply output=mesh.ply
FROM python:3.13-slim-trixie
RUN apt-get update && apt-get install -y --no-install-recommends libusb-1.0-0 libgl1 libegl1 libidn2-0 && rm -rf /var/lib/apt/lists/*
WORKDIR /opt/pnu
COPY constraints.txt ./
# the CPU build of torch first: the usual one brings gigabytes of CUDA
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
RUN pip install --no-cache-dir --constraint constraints.txt --index-url "$TORCH_INDEX" --no-deps torch
COPY pyproject.toml README.md LICENSE ./
COPY conf conf
COPY pnu pnu
RUN pip install --no-cache-dir --constraint constraints.txt ".[figures,poisson,las,e57]"
RUN useradd --create-home pnu && install --directory --owner=pnu /data
WORKDIR /data
USER pnu
ENV HOME=/home/pnu
# compiled kernels and caches are for whoever runs it, see --user
RUN pnu doctor --install --no-system && pnu doctor --require && chmod -R a+rwX /home/pnu
ENTRYPOINT ["pnu"]
