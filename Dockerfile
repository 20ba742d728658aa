# pnu on the CPU: docker build -t pnu . && docker run --rm -v "$PWD:/data" pnu scan input=scan.ply output=mesh.ply
FROM python:3.13-slim-trixie
RUN apt-get update && apt-get install -y --no-install-recommends libusb-1.0-0 libgl1 libegl1 && rm -rf /var/lib/apt/lists/*
WORKDIR /opt/pnu
# the CPU build of torch first: the usual one brings gigabytes of CUDA
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
RUN pip install --no-cache-dir --index-url "$TORCH_INDEX" "torch>=2.6"
COPY pyproject.toml README.md LICENSE ./
COPY conf conf
COPY pnu pnu
RUN pip install --no-cache-dir ".[figures,poisson,las,e57]" && pnu doctor --install --no-system
WORKDIR /data
ENTRYPOINT ["pnu"]
