# docker build -t posefilter .
# docker run --rm --user "$(id -u):$(id -g)" -v "$PWD":/work posefilter predict checkpoint=003_cracker_box rgb=a.png depth=a_depth.png intrinsics=fx,fy,cx,cy depth_scale=1000
# Without --user what is written belongs to root.
# For a GPU: docker build --build-arg TORCH=https://pypi.org/simple, whose torch has CUDA, and docker run --gpus all.
# To train there, also --shm-size=2g: the loader's processes hand images on in /dev/shm, for which Docker has 64 MB.
FROM python:3.11-slim AS wheel
WORKDIR /source
COPY pyproject.toml setup.py MANIFEST.in README.md LICENSE ./
COPY src src
COPY conf conf
COPY weights weights
RUN pip wheel . --no-deps --wheel-dir /wheel

FROM python:3.11-slim
ARG TORCH=https://download.pytorch.org/whl/cpu
# as in pyproject.toml: a newer one would be replaced by that of PyPI, with gigabytes of CUDA
RUN pip install --no-cache-dir 'torch>=2.6,<2.14' --index-url "$TORCH"
COPY --from=wheel /wheel /wheel
RUN pip install --no-cache-dir /wheel/*.whl && rm -r /wheel
WORKDIR /work
ENTRYPOINT ["posefilter"]
