# querysplat on the CPU. Build in the root of the repository, and run in the folder of your photos:
#   docker build -f docker/cpu.Dockerfile -t querysplat .
#   docker run --rm -v "$PWD:/data" --user "$(id -u):$(id -g)" querysplat reconstruct photos/ -o scene.ply
FROM python:3.11-slim-bookworm

# Numba's threads use the system's OpenMP.
RUN apt-get update && apt-get install -y --no-install-recommends libgomp1 && rm -rf /var/lib/apt/lists/*
WORKDIR /opt/querysplat
COPY . .
# The index of CPU builds keeps CUDA's packages, several gigabytes, out of the image.
RUN pip install --no-cache-dir -c constraints.txt --extra-index-url https://download.pytorch.org/whl/cpu \
        'torch==2.13.0+cpu' '.[formats,heic,mesh]' \
    # Kernels are compiled into the image, so that no run has to do it.
    && NUMBA_CACHE_DIR=/opt/numba querysplat demo -o /tmp/demo --quiet \
    && rm -r /tmp/demo \
    && chmod -R a+rwX /opt/numba
ENV NUMBA_CACHE_DIR=/opt/numba MPLCONFIGDIR=/tmp/matplotlib

WORKDIR /data
ENTRYPOINT ["querysplat"]
CMD ["--help"]
