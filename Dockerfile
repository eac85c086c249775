# Demo, emulated device and every command:
#   docker build -t turbidostat .
#   docker run --rm -v "$PWD/runs:/data/runs" turbidostat                                   the demo
#   docker run --rm -p 5000:5000 -p 5001:5001 --entrypoint python turbidostat -m hardware.emulator --host 0.0.0.0
FROM python:3.11-slim
COPY pyproject.toml constraints.txt README.md LICENSE /src/
COPY conf /src/conf
COPY dqn /src/dqn
COPY envs /src/envs
COPY hardware /src/hardware
COPY experiments /src/experiments
RUN python -m pip install --no-cache-dir -c /src/constraints.txt /src
WORKDIR /data
ENTRYPOINT ["turbidostat"]
CMD ["demo"]
