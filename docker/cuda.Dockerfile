# querysplat on an NVIDIA GPU, for the official presets, --device cuda and training:
#   docker build -f docker/cuda.Dockerfile -t querysplat:cuda .
#   docker run --rm --gpus all -v "$PWD:/data" --user "$(id -u):$(id -g)" querysplat:cuda doctor
# The image has CUDA's compiler, because gsplat compiles its kernels when they are first used.
# Its version must be the one that torch was built with (torch.version.cuda); --build-arg CUDA=… changes it.
ARG CUDA=12.8.1
FROM nvidia/cuda:${CUDA}-devel-ubuntu22.04

RUN apt-get update \
    && apt-get install -y --no-install-recommends software-properties-common \
    && add-apt-repository -y ppa:deadsnakes/ppa \
    && apt-get install -y --no-install-recommends python3.11 python3.11-dev python3.11-venv \
    && rm -rf /var/lib/apt/lists/* \
    && python3.11 -m venv /opt/venv
ENV PATH=/opt/venv/bin:$PATH

WORKDIR /opt/querysplat
COPY . .
RUN pip install --no-cache-dir -c constraints.txt '.[formats,heic,mesh,cuda,weights]'
ENV NUMBA_CACHE_DIR=/tmp/numba MPLCONFIGDIR=/tmp/matplotlib TORCH_EXTENSIONS_DIR=/tmp/torch_extensions

WORKDIR /data
ENTRYPOINT ["querysplat"]
CMD ["--help"]
