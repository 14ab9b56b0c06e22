# Turbo-Pi on x86-64. How to build, run and update it: docs/docker.md
#   docker build -t turbopi .                                  NVIDIA GPU, driver 580 or newer
#   docker build -t turbopi:cpu --build-arg DEVICE=cpu .       no GPU
ARG BASE=debian:bookworm-slim
FROM ${BASE}

# g++ and Python.h: Triton and torch.compile compile when a policy warms up
RUN apt-get update \
    && apt-get install --yes --no-install-recommends ca-certificates g++ python3-dev python3-venv \
    && rm -rf /var/lib/apt/lists/* \
    && python3 -m venv /opt/turbopi
ENV PATH=/opt/turbopi/bin:$PATH \
    PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PYTHONUNBUFFERED=1 \
    NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility

# PyTorch in a layer of its own, which stays when Turbo-Pi alone changes. For GPUs: the versions of the extra `cuda`
ARG DEVICE=cuda
ARG CPU_TORCH="torch==2.13.0 --index-url https://download.pytorch.org/whl/cpu"
WORKDIR /src
COPY pyproject.toml README.md LICENSE NOTICE ./
RUN case "$DEVICE" in \
      cuda) pip install $(python -c "import tomllib; print(*tomllib.load(open('pyproject.toml', 'rb'))['project']['optional-dependencies']['cuda'])") ;; \
      cpu) pip install $CPU_TORCH ;; \
      *) echo "DEVICE is '$DEVICE'; expected cuda or cpu" >&2; exit 1 ;; \
    esac
# of pyproject.toml's extras, with commas between them: ray for fleets, view, …
ARG EXTRAS=""
COPY src ./src
RUN pip install ".${EXTRAS:+[$EXTRAS]}" \
    && ln -s "$(python -c 'from turbopi.policy.shipped import SMALL_POLICY; print(SMALL_POLICY)')" /small_policy \
    && useradd --create-home --uid 1000 robot \
    && install --directory --owner robot /home/robot/.cache

USER robot
WORKDIR /home/robot
EXPOSE 8000
# A checkpoint loads and warms up before the port answers
HEALTHCHECK --interval=10s --timeout=5s --start-period=10m \
    CMD ["python", "-c", "import urllib.request as u; u.build_opener(u.ProxyHandler({})).open('http://127.0.0.1:8000/healthz', timeout=4)"]
ENTRYPOINT ["turbopi"]
CMD ["serve", "/small_policy", "--host", "0.0.0.0"]
