# docker build --tag alidade .          # docker buildx build --platform linux/amd64,linux/arm64 for both processors
# docker run --rm --user "$(id -u)" --volume "$PWD:/work" alidade calibrate session.mcap
FROM python:3.13-slim AS build
COPY . /src
RUN python -m venv /opt/alidade && \
    /opt/alidade/bin/pip install --no-cache-dir --only-binary=:all: --no-binary=alidade /src -c /src/constraints.txt && \
    /opt/alidade/bin/pip uninstall --yes pip

FROM python:3.13-slim
COPY --from=build /opt/alidade /opt/alidade
RUN useradd --create-home alidade
USER alidade
ENV PATH=/opt/alidade/bin:$PATH HOME=/tmp
WORKDIR /work
ENTRYPOINT ["alidade"]
