# docker build -t posefilter . ; docker run --rm -v "$PWD":/work posefilter predict checkpoint=003_cracker_box rgb=a.png depth=a_depth.png intrinsics=fx,fy,cx,cy
# For a GPU: --build-arg TORCH=https://download.pytorch.org/whl/cu128, and docker run --gpus all.
FROM python:3.11-slim AS wheel
WORKDIR /source
COPY pyproject.toml setup.py MANIFEST.in README.md LICENSE ./
COPY src src
COPY conf conf
COPY weights weights
RUN pip wheel . --no-deps --wheel-dir /wheel

FROM python:3.11-slim
ARG TORCH=https://download.pytorch.org/whl/cpu
COPY --from=wheel /wheel /wheel
RUN pip install --no-cache-dir torch --index-url "$TORCH" && pip install --no-cache-dir /wheel/*.whl && rm -r /wheel
WORKDIR /work
ENTRYPOINT ["posefilter"]
