# Two images: `docker build --target cpu -t playground:cpu .` and `docker build --target cuda -t playground:cuda .`.
# The CUDA image needs NVIDIA's driver and container toolkit on the host; CUDA's libraries come with JAX.
FROM python:3.12-slim AS base
RUN apt-get update && apt-get install --yes --no-install-recommends git libegl1 libgl1 \
  && rm -rf /var/lib/apt/lists/*
WORKDIR /source
COPY . .

FROM base AS cpu
RUN pip install --no-cache-dir --constraint constraints.txt '.[vision,deploy,web,gym]'
WORKDIR /work
ENTRYPOINT ["playground"]
CMD ["doctor"]

FROM base AS cuda
ENV NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics
RUN pip install --no-cache-dir --constraint constraints.txt '.[cuda13,deploy,web,gym]'
WORKDIR /work
ENTRYPOINT ["playground"]
CMD ["doctor"]
